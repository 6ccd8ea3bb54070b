"""The body in any pose: known answers with the free template, batches, gradients, requests that
cannot be met.

J joints, M vertices, F frames.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from torch import Tensor

from dyngs.human.body.body import (
    BONE_UNIT,
    PAIRED_JOINTS,
    BodyTemplate,
    apply_shape,
    bone_shape_directions,
    posed_vertices,
)
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.joints import JOINT_NAMES

SIDES = {
    1: 2,
    4: 5,
    7: 8,
    10: 11,
    13: 14,
    16: 17,
    18: 19,
    20: 21,
    23: 24,
    **{i: i + 15 for i in range(25, 40)},
}
"""Left joints of SMPL-X and their counterparts on the right."""


@pytest.fixture(scope="module")
def template() -> BodyTemplate:
    return default_template()


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def tiny(shapes: int = 3) -> BodyTemplate:
    """4 joints in a fork, 6 vertices, all that SMPL-X has; float64."""
    j, m = 4, 6
    return BodyTemplate(
        name="tiny",
        vertices=normal(m, 3),
        faces=torch.tensor([[0, 1, 2], [3, 4, 5]]),
        uv=None,
        uv_faces=None,
        weights=torch.softmax(normal(m, j, seed=1), 1),
        parents=(-1, 0, 1, 0),
        joints=normal(j, 3, seed=2),
        shape_dirs=normal(m, 3, shapes, seed=3),
        joint_shape_dirs=normal(j, 3, shapes, seed=5),
        pose_dirs=0.1 * normal(9 * (j - 1), 3 * m, seed=7),
    )


# --- the free template
# ------------------------------------------------------------------------------------------------


def test_the_template_is_a_person_of_normal_size_who_faces_forward(template: BodyTemplate) -> None:
    assert template.name == "anny"
    assert (len(template.joints), len(template.vertices), len(template.faces)) == (55, 13718, 27420)
    height = float(template.vertices[:, 1].max() - template.vertices[:, 1].min())
    assert height == pytest.approx(1.761, abs=1e-3)
    for left, right in SIDES.items():
        assert template.joints[left, 0] > 0 > template.joints[right, 0]
    assert template.joints[10, 2] > template.joints[7, 2], "toes are in front of the ankles"
    torch.testing.assert_close(template.weights.sum(1), torch.ones(13718))
    assert template.num_shapes == 44


def test_its_surface_is_closed_and_faces_outward(template: BodyTemplate) -> None:
    """By the divergence theorem the volume is positive: about that of 75 kg."""
    a, b, c = template.vertices.double()[template.faces].unbind(1)
    volume = float((a * torch.linalg.cross(b, c)).sum() / 6)
    assert 0.05 < volume < 0.1
    edges = torch.cat(
        [template.faces[:, [0, 1]], template.faces[:, [1, 2]], template.faces[:, [2, 0]]]
    )
    forward, backward = (x[:, 0] * len(template.vertices) + x[:, 1] for x in (edges, edges.flip(1)))
    assert torch.equal(forward.sort().values, backward.sort().values)
    assert len(forward.unique()) == len(forward)


def test_the_mirrored_pose_is_the_mirrored_body(template: BodyTemplate) -> None:
    """Left and right changed, y and z of the axes reversed. The template is symmetric to a fraction
    of a millimetre."""
    poses = 0.3 * normal(1, 55, 3).float()
    mirrored = poses * torch.tensor([1.0, -1.0, -1.0])
    swap = list(range(55))
    for left, right in SIDES.items():
        swap[left], swap[right] = right, left
    both = torch.cat([poses, mirrored[:, swap]])
    one, other = posed_vertices(template, both, torch.zeros(2, 3))
    _, twins = KDTree(template.vertices.numpy()).query(
        (template.vertices * torch.tensor([-1.0, 1, 1])).numpy()
    )
    gaps = (one[torch.from_numpy(twins)] * torch.tensor([-1.0, 1, 1]) - other).norm(dim=1)
    assert float(gaps.mean()) < 2e-4
    assert float(gaps.max()) < 1e-2


# --- shape and expression
# ---------------------------------------------------------------------------------------------


def test_shape_moves_vertices_and_joints_linearly() -> None:
    body = tiny()
    betas = torch.tensor([0.5, -1, 2]).double()
    vertices, joints = apply_shape(body, betas)
    assert body.shape_dirs is not None
    assert body.joint_shape_dirs is not None
    expected = body.vertices.clone()
    expected_joints = body.joints.clone()
    for i, amount in enumerate(betas):
        expected += amount * body.shape_dirs[:, :, i]
        expected_joints += amount * body.joint_shape_dirs[:, :, i]
    torch.testing.assert_close(vertices, expected)
    torch.testing.assert_close(joints, expected_joints)


# --- batches, types, gradients
# ----------------------------------------------------------------------------------------


def test_pose_blend_shapes_follow_all_rotations_but_the_root() -> None:
    body = tiny()
    poses = torch.zeros(1, 4, 3).double()
    plain = replace(body, pose_dirs=None)
    poses[0, 0] = normal(3)
    torch.testing.assert_close(
        posed_vertices(body, poses, normal(1, 3)), posed_vertices(plain, poses, normal(1, 3))
    )
    poses[0, 2] = normal(3)
    assert not torch.allclose(
        posed_vertices(body, poses, normal(1, 3)), posed_vertices(plain, poses, normal(1, 3))
    )


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_gradients(size: float) -> None:
    body = tiny()
    given = (size * normal(2, 4, 3), normal(2, 3), normal(3), normal(2).exp())
    assert torch.autograd.gradcheck(
        lambda *x: posed_vertices(body, *x), tuple(x.requires_grad_() for x in given)
    )


# --- what does not fit
# ------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def bare_template() -> tuple[BodyTemplate, np.ndarray, np.ndarray]:
    body = default_template()
    arrays = (x.double().numpy() for x in (body.vertices, body.joints, body.weights))
    vertices, joints, weights = arrays
    return body, *bone_shape_directions(vertices, joints, body.parents, weights)


def test_both_sides_move_as_mirror_images() -> None:
    _, _, joints = bare_template()
    for name in PAIRED_JOINTS:
        left, right = (joints[JOINT_NAMES.index(f"{side}_{name}")] for side in ("left", "right"))
        assert np.array_equal(left * np.array([-1, 1, 1])[:, None], right)


def test_a_bone_moves_all_that_is_below_it_and_nothing_else() -> None:
    _, _, joints = bare_template()
    knee = joints[:, :, 3 * PAIRED_JOINTS.index("knee") + 1]
    moved = {name for name, move in zip(JOINT_NAMES, knee, strict=True) if move.any()}
    assert moved == {
        f"{side}_{name}" for side in ("left", "right") for name in ("knee", "ankle", "foot")
    }
    assert knee[JOINT_NAMES.index("left_foot"), 1] == pytest.approx(BONE_UNIT)
