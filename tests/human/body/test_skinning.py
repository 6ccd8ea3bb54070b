"""Rotations, the kinematic chain and the blend against slow loops in float64, and what they promise
at rest.

P points follow J joints.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.human.body.skinning import (
    axis_angle_to_matrix,
    joint_transforms,
)

CHAIN = tuple(range(-1, 11))
STAR = (-1, *([0] * 11))


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def trees(largest: int = 20) -> st.SearchStrategy[tuple[int, ...]]:
    """Parents of 1 to ``largest`` joints, any earlier joint or none."""
    choices = st.lists(st.integers(0, 2**16), max_size=largest - 1)
    return choices.map(lambda drawn: (-1, *(x % (i + 2) - 1 for i, x in enumerate(drawn))))


def slow_transforms(joints: np.ndarray, parents: tuple[int, ...], turned: np.ndarray) -> np.ndarray:
    """A_j = [G_R | G_t - G_R J_j] with G_j = G_parent [R_j | J_j - J_parent], joint after joint."""
    chain = []
    for joint, parent in enumerate(parents):
        local = np.eye(4)
        local[:3, :3] = turned[joint]
        local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        chain.append(chain[parent] @ local if parent >= 0 else local)
    found = []
    for at, joint in zip(chain, joints, strict=True):
        found.append(np.column_stack([at[:3, :3], at[:3, 3] - at[:3, :3] @ joint]))
    return np.array(found)


# --- rotations
# ----------------------------------------------------------------------------------------------


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(-4, 4), min_size=3, max_size=3), st.integers(-12, 1))
def test_rotations_are_those_of_scipy_at_any_angle(axis: list[float], exponent: int) -> None:
    pose = np.array(axis) * 10.0**exponent
    found = axis_angle_to_matrix(torch.from_numpy(pose))
    np.testing.assert_allclose(found, Rotation.from_rotvec(pose).as_matrix(), rtol=0, atol=1e-13)
    torch.testing.assert_close(found @ found.T, torch.eye(3).double(), rtol=0, atol=1e-13)
    single = axis_angle_to_matrix(torch.from_numpy(pose).float())
    # The angle, as large as the pose is long, comes of rounded components by a rounded norm: two
    # units of it; sines, axis and products add ten more.
    allowed = torch.finfo(torch.float32).eps * (2 * float(np.linalg.norm(pose)) + 10)
    torch.testing.assert_close(single, found.float(), rtol=0, atol=allowed)


def test_no_turn_is_exactly_the_identity_and_has_the_gradient_of_the_cross_product() -> None:
    for dtype in (torch.float32, torch.float64):
        pose = torch.zeros(2, 3, dtype=dtype, requires_grad=True)
        turned = axis_angle_to_matrix(pose)
        assert torch.equal(turned, torch.eye(3, dtype=dtype).expand(2, 3, 3))
        (
            turned[0, 2, 1] + 2 * turned[0, 0, 2] + 4 * turned[0, 1, 0] + 8 * turned[1].trace()
        ).backward()
        assert pose.grad is not None
        assert pose.grad.tolist() == [[1, 2, 4], [0, 0, 0]]


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-9, 1e-4, 0.3, 3.1415926, 7.0])
def test_gradients_of_rotations(size: float) -> None:
    pose = (normal(2, 3) * size).requires_grad_()
    assert torch.autograd.gradcheck(axis_angle_to_matrix, (pose,), atol=1e-7)


# --- the chain
# ----------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(trees(), st.integers(0, 100))
def test_transforms_are_those_of_the_loop_over_any_tree(
    parents: tuple[int, ...], seed: int
) -> None:
    joints = normal(len(parents), 3, seed=seed)
    turned = axis_angle_to_matrix(normal(len(parents), 3, seed=seed + 1))
    found = joint_transforms(joints, parents, turned)
    np.testing.assert_allclose(
        found, slow_transforms(joints.numpy(), parents, turned.numpy()), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("parents", [CHAIN, STAR, (-1,)])
def test_rest_is_exactly_the_identity_wherever_the_joints_are(parents: tuple[int, ...]) -> None:
    joints = normal(len(parents), 3).float()
    found = joint_transforms(joints, parents, axis_angle_to_matrix(torch.zeros(len(parents), 3)))
    assert torch.equal(found, torch.eye(3, 4).expand(len(parents), 3, 4))


def test_gradients_of_the_chain() -> None:
    joints = normal(6, 3).requires_grad_()
    pose = normal(2, 6, 3, seed=1).requires_grad_()
    for at in (pose, torch.zeros_like(pose).requires_grad_()):
        assert torch.autograd.gradcheck(
            lambda j, p: joint_transforms(j, (-1, 0, 1, 1, 3, 0), axis_angle_to_matrix(p)),
            (joints, at),
        )


@pytest.mark.parametrize("parents", [(0,), (-1, 1), (-1, 2, 1), (-1, 0, -2), (-1, 5)])
def test_a_tree_out_of_order_is_refused_and_never_followed(parents: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="parents must come before their children"):
        joint_transforms(
            normal(len(parents), 3), parents, axis_angle_to_matrix(normal(len(parents), 3))
        )


# --- the blend
# ----------------------------------------------------------------------------------------------
