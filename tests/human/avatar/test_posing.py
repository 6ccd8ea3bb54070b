"""Posed Gaussians with known answers: rest, a bent elbow, mirrored poses, turned colours, and
fractions of joints.

N Gaussians, J joints.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import synthetic_bodies
import torch
from torch import Tensor

from dyngs.core.conventions import SH_C0
from dyngs.gaussians import Gaussians
from dyngs.human.avatar.posing import (
    NUM_LIGHT_TERMS,
    Anchors,
    BodyPose,
    Skeleton,
    blended_rotations,
    pose_blend_shapes,
    pose_gaussians,
    rotate_sh,
    skinning_weights,
    texel_gaussians,
)
from dyngs.human.body.atlas import atlas_texels
from dyngs.human.body.body import BodyTemplate, posed_vertices
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.ops.harmonics import evaluate_harmonics, lit
from dyngs.ops.quaternions import rotation_matrices
from tests.bare_person import bare_scene


def from_the_left() -> Tensor:
    """Twice as bright as even light where the surface faces +x, black where it faces -x; red
    only."""
    factors = torch.zeros(NUM_LIGHT_TERMS, 3)
    factors[0, 0] = 1.0
    return factors


def turned(angle: float) -> Tensor:
    """A rotation about y."""
    c = math.cos(angle)
    s = math.sin(angle)
    return torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def colours(sh: Tensor) -> Tensor:
    return 0.5 + SH_C0 * sh[:, 0]


def test_gradients_are_those_of_finite_differences() -> None:
    make = torch.Generator().manual_seed(1)
    shapes = ((3, 1, 3), (3, 3, 3), (3, 3), (NUM_LIGHT_TERMS, 3))
    values = [
        torch.randn(shape, generator=make, dtype=torch.float64).requires_grad_() for shape in shapes
    ]
    assert torch.autograd.gradcheck(lit, values)


def test_a_person_is_lit_in_the_world() -> None:
    scene = bare_scene(light=True)
    dark, _ = scene.gaussians_in_frame(0)
    scene.learned["light"].data.copy_(from_the_left())
    lit, _ = scene.gaussians_in_frame(0)
    assert torch.equal(lit.means, dark.means)
    ratio = colours(lit.sh) / colours(dark.sh)
    torch.testing.assert_close(ratio[:, 1:], torch.ones_like(ratio[:, 1:]), atol=1e-5, rtol=0)
    right = ratio[:, 0].topk(500, largest=False).indices
    left = ratio[:, 0].topk(500).indices
    middle = dark.means[:, 0].median()
    assert dark.means[left, 0].median() > middle > dark.means[right, 0].median()


RESOLUTION = 48


@cache
def person(sh_degree: int = 0) -> tuple[BodyTemplate, Gaussians, Anchors, Tensor]:
    """The free template with one scaffold, and its dense weights."""
    body = default_template()
    gaussians, anchors = texel_gaussians(atlas_texels(body, RESOLUTION), (0.0, 0.02), sh_degree)
    generator = torch.Generator().manual_seed(0)
    gaussians = gaussians.replace(sh=0.3 * torch.randn(gaussians.sh.shape, generator=generator))
    return body, gaussians, anchors, skinning_weights(anchors, len(body.joints))


def in_pose(
    turns: dict[int, tuple[float, float, float]], gaussians: Gaussians | None = None
) -> Gaussians:
    """The person with some joints turned by axis-angle vectors, rad."""
    body, rest, _, weights = person()
    poses = torch.zeros(len(body.joints), 3)
    for joint, turn in turns.items():
        poses[joint] = torch.tensor(turn)
    posing = BodyPose(axis_angle_to_matrix(poses), torch.zeros(3), torch.tensor(1.0))
    return pose_gaussians(gaussians or rest, weights, Skeleton(body.joints, body.parents), posing)


def covariances(gaussians: Gaussians) -> Tensor:
    half = rotation_matrices(gaussians.quats) * gaussians.scales[:, None, :]
    return half @ half.mT


def test_the_template_at_rest_is_canonical() -> None:
    _, rest, _, _ = person()
    found = in_pose({})
    torch.testing.assert_close(found.means, rest.means, rtol=0, atol=1e-6)
    torch.testing.assert_close(covariances(found), covariances(rest), rtol=1e-3, atol=1e-9)
    assert found.sh is rest.sh


def test_a_mirrored_pose_mirrors_the_result() -> None:
    """x -> -x: the two sides change positions, and axis-angle vectors keep x only."""
    body, _, _, _ = person()
    swapped = {"left": "right", "right": "left"}
    sides = (name.partition("_") for name in JOINT_NAMES)
    other = [JOINT_NAMES.index(swapped.get(side, side) + line + rest) for side, line, rest in sides]
    mirror = torch.tensor([-1.0, 1.0, 1.0])
    joints = 0.5 * (body.joints + mirror * body.joints[other])
    generator = torch.Generator().manual_seed(1)
    poses = 0.4 * torch.randn(len(JOINT_NAMES), 3, generator=generator)
    mirrored_poses = -mirror * poses[other]
    count = 30
    weights = torch.rand(count, len(JOINT_NAMES), generator=generator).pow(4)
    weights = weights / weights.sum(1, keepdim=True)
    means = torch.randn(count, 3, generator=generator)
    quats = torch.randn(count, 4, generator=generator)
    log_scales = torch.randn(count, 3, generator=generator) - 3
    rest = Gaussians(means, quats, log_scales, torch.zeros(count), torch.zeros(count, 1, 3))
    flipped = rest.replace(means=mirror * means, quats=quats * torch.tensor([1.0, 1.0, -1.0, -1.0]))
    skeleton = Skeleton(joints, body.parents)
    still = (torch.zeros(3), torch.tensor(1.0))
    one = pose_gaussians(rest, weights, skeleton, BodyPose(axis_angle_to_matrix(poses), *still))
    two = pose_gaussians(
        flipped, weights[:, other], skeleton, BodyPose(axis_angle_to_matrix(mirrored_poses), *still)
    )
    torch.testing.assert_close(two.means, mirror * one.means, rtol=0, atol=1e-5)
    wanted = mirror[:, None] * covariances(one) * mirror
    torch.testing.assert_close(covariances(two), wanted, rtol=1e-3, atol=1e-6)


def test_colours_turn_with_what_they_are_on() -> None:
    """Seen along a direction that is turned like the Gaussians, they look as they did."""
    generator = torch.Generator().manual_seed(2)
    sh = 0.3 * torch.randn(7, 4, 3, generator=generator)
    turns = axis_angle_to_matrix(2 * torch.randn(7, 3, generator=generator))
    seen = torch.nn.functional.normalize(torch.randn(7, 3, generator=generator), dim=1)
    turned = (turns @ seen[..., None])[..., 0]
    radii = torch.ones(1, 7, 2, dtype=torch.int32)
    eye = torch.zeros(1, 3)
    before = evaluate_harmonics(seen, eye, sh, radii, 1)
    after = evaluate_harmonics(turned, eye, rotate_sh(sh, turns), radii, 1)
    torch.testing.assert_close(after, before, rtol=0, atol=1e-6)
    assert float((evaluate_harmonics(turned, eye, sh, radii, 1) - before).abs().max()) > 0.05


def test_blended_rotations_have_the_gradients_of_differences() -> None:
    generator = torch.Generator().manual_seed(5)
    weights = torch.rand(6, 3, dtype=torch.float64, generator=generator).requires_grad_()
    poses = torch.randn(3, 3, dtype=torch.float64, generator=generator).requires_grad_()
    rest = torch.zeros(3, 3, 1, dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda w, p: blended_rotations(w, torch.cat([axis_angle_to_matrix(p), rest], dim=-1)),
        (weights, poses),
    )


@cache
def rigid_body() -> BodyTemplate:
    """A body of random triangles with SMPL's joints and pose blend shapes; each triangle follows
    one joint alone."""
    generator = np.random.default_rng(0)
    arrays = synthetic_bodies.model("smpl")
    groups = torch.arange(len(arrays["v_template"])) // 3
    faces = torch.stack([3 * groups.unique() + k for k in range(3)], dim=1)
    followed = torch.from_numpy(generator.integers(0, 24, len(faces)))[groups]
    return BodyTemplate(
        name="smpl",
        vertices=torch.from_numpy(arrays["v_template"]).float(),
        faces=faces,
        uv=torch.from_numpy(generator.uniform(0, 1, (len(groups), 2))).float(),
        uv_faces=faces,
        weights=torch.nn.functional.one_hot(followed, 24).float(),
        parents=tuple(synthetic_bodies.parents_of("smpl")),
        joints=torch.from_numpy(arrays["J"]).float(),
        pose_dirs=20 * torch.from_numpy(arrays["posedirs"].reshape(-1, 207).T.copy()).float(),
    )


def test_blend_shapes_of_the_template_move_texels_as_its_surface() -> None:
    """In triangles that follow a single joint, posed texels are the barycentric points of the posed
    mesh."""
    body = rigid_body()
    generator = torch.Generator().manual_seed(0)
    poses = 0.5 * torch.randn(24, 3, generator=generator)
    posing = BodyPose(axis_angle_to_matrix(poses), torch.tensor([1.0, 2.0, 3.0]), torch.tensor(1.5))
    gaussians, anchors = texel_gaussians(atlas_texels(body, 24), (0.0,), 0)
    weights = skinning_weights(anchors, 24)
    shapes = pose_blend_shapes(body)
    assert shapes is not None
    offsets = shapes.offsets(anchors, posing.rotations)
    found = pose_gaussians(
        gaussians, weights, Skeleton(body.joints, body.parents), posing, offsets
    ).means
    given = (poses[None], posing.trans[None], None, posing.scale[None])
    mesh, stiff = (posed_vertices(b, *given)[0] for b in (body, replace(body, pose_dirs=None)))
    wanted, without = (
        (anchors.barycentric[..., None] * x[body.faces[anchors.face]]).sum(1) for x in (mesh, stiff)
    )
    assert float((wanted - without).norm(dim=1).mean()) > 0.1
    # 2^-11 of offsets of half a metre, shared by 207 numbers that round independently
    torch.testing.assert_close(found, wanted, rtol=0, atol=2e-4)
    exact = replace(shapes, directions=body.pose_dirs).offsets(anchors, posing.rotations)
    found = pose_gaussians(
        gaussians, weights, Skeleton(body.joints, body.parents), posing, exact
    ).means
    torch.testing.assert_close(found, wanted, rtol=0, atol=2e-6)


@pytest.mark.parametrize("sh_degree", [0, 1])
def test_posing_is_differentiable_in_everything(sh_degree: int) -> None:
    body, rest, anchors, _ = person(sh_degree)
    leaves = {name: x.clone().requires_grad_() for name, x in rest.tensors().items()}
    poses = torch.zeros(len(body.joints), 3, requires_grad=True)
    joints = body.joints.clone().requires_grad_()
    corrections = torch.zeros_like(anchors.weights).requires_grad_()
    weights = skinning_weights(anchors, len(joints), corrections)
    posing = BodyPose(axis_angle_to_matrix(poses + 0.3), torch.zeros(3), torch.tensor(1.0))
    found = pose_gaussians(Gaussians(**leaves), weights, Skeleton(joints, body.parents), posing)
    flat = torch.cat([x.flatten() for x in found.tensors().values()])
    (flat * torch.linspace(1, 2, len(flat))).sum().backward()
    for x in (*leaves.values(), poses, joints, corrections):
        assert x.grad is not None
        assert bool(x.grad.isfinite().all())
        assert bool((x.grad != 0).any())
