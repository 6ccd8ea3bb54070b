"""The body in any pose: known answers with the free template, batches, gradients, requests that
cannot be met.

J joints, M vertices, F frames.
"""

from __future__ import annotations

import math
from dataclasses import fields, replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.human.body.body import (
    BONE_UNIT,
    NUM_BONE_SHAPES,
    SIDED,
    BodyTemplate,
    apply_shape,
    bone_shapes,
    posed_vertices,
)
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.joints import JOINT_NAMES

LEFT_ELBOW = 18
LEFT_WRIST = 20
LEFT_FINGERS = range(25, 40)
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


def tiny(shapes: int = 3, expressions: int = 2) -> BodyTemplate:
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
        expression_dirs=normal(m, 3, expressions, seed=4),
        joint_shape_dirs=normal(j, 3, shapes, seed=5),
        joint_expression_dirs=normal(j, 3, expressions, seed=6),
        pose_dirs=0.1 * normal(9 * (j - 1), 3 * m, seed=7),
    )


def about_z(angle: float) -> Tensor:
    return torch.tensor([0.0, 0.0, angle])


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
    assert (template.num_shapes, template.num_expressions) == (44, 0)


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


def test_its_texture_coordinates_belong_to_the_corners(template: BodyTemplate) -> None:
    assert template.uv is not None
    assert template.uv_faces is not None
    assert template.uv.min() >= 0
    assert template.uv.max() <= 1
    assert template.uv_faces.unique().tolist() == list(range(len(template.uv)))
    pairs = torch.stack([template.uv_faces.flatten(), template.faces.flatten()], 1).unique(dim=0)
    assert len(pairs) == len(template.uv), "each texture coordinate belongs to one vertex"


def test_rest_is_the_template(template: BodyTemplate) -> None:
    found = posed_vertices(template, torch.zeros(2, 55, 3), torch.zeros(2, 3))
    # one bit of 1.0 m
    torch.testing.assert_close(found, template.vertices.expand(2, -1, -1), rtol=0, atol=2e-7)


def test_an_elbow_bent_by_90_degrees_lifts_the_forearm(template: BodyTemplate) -> None:
    """The left arm lies along +x; about +z it goes from +x to +y. What follows only the hand turns
    about the elbow."""
    poses = torch.zeros(1, 55, 3)
    poses[0, LEFT_ELBOW] = about_z(math.pi / 2)
    found = posed_vertices(template, poses, torch.zeros(1, 3))[0]
    hand = template.weights[:, [LEFT_WRIST, *LEFT_FINGERS]].sum(1) > 1 - 1e-6
    assert hand.sum() > 500
    elbow = template.joints[LEFT_ELBOW]
    arm = template.vertices[hand] - elbow
    expected = torch.stack(
        [elbow[0] - arm[:, 1], elbow[1] + arm[:, 0], template.vertices[hand, 2]], 1
    )
    torch.testing.assert_close(found[hand], expected, rtol=0, atol=1e-6)
    assert found[hand, 1].min() > elbow[1] + 0.2
    still = template.weights[:, [LEFT_ELBOW, LEFT_WRIST, *LEFT_FINGERS]].sum(1) == 0
    torch.testing.assert_close(found[still], template.vertices[still], rtol=0, atol=2e-7)


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


def test_the_root_turns_all_about_the_pelvis_before_scale_and_shift(template: BodyTemplate) -> None:
    poses = torch.zeros(1, 55, 3)
    poses[0, 0] = about_z(math.pi / 2)
    trans = torch.tensor([[1.0, 2.0, 3.0]])
    found = posed_vertices(template, poses, trans, scale=torch.tensor([2.0]))[0]
    x, y, z = (template.vertices - template.joints[0]).unbind(1)
    expected = 2 * (template.joints[0] + torch.stack([-y, x, z], 1)) + trans
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-6)


# --- shape and expression
# ---------------------------------------------------------------------------------------------


def test_shape_moves_vertices_and_joints_linearly() -> None:
    body = tiny()
    betas = torch.tensor([0.5, -1, 2]).double()
    expression = torch.tensor([3.0, -0.25]).double()
    vertices, joints = apply_shape(body, betas, expression)
    expected = body.vertices.clone()
    expected_joints = body.joints.clone()
    for amounts, dirs, joint_dirs in (
        (betas, body.shape_dirs, body.joint_shape_dirs),
        (expression, body.expression_dirs, body.joint_expression_dirs),
    ):
        assert dirs is not None
        assert joint_dirs is not None
        for i, amount in enumerate(amounts):
            expected += amount * dirs[:, :, i]
            expected_joints += amount * joint_dirs[:, :, i]
    torch.testing.assert_close(vertices, expected)
    torch.testing.assert_close(joints, expected_joints)


def test_parameters_not_given_are_zero() -> None:
    body = tiny()
    one = torch.tensor([0.7]).double()
    torch.testing.assert_close(
        apply_shape(body, one), apply_shape(body, torch.tensor([0.7, 0, 0]).double())
    )
    assert apply_shape(body, None) == (body.vertices, body.joints)
    assert torch.equal(apply_shape(body, one[:0])[0], body.vertices)


def test_zeros_that_the_body_has_no_use_for_are_fine(template: BodyTemplate) -> None:
    """Motion files come with 10 or 16 of them."""
    assert torch.equal(apply_shape(template, torch.zeros(10))[0], template.vertices)
    found = apply_shape(tiny(), torch.tensor([1.0, 2, 3, 0, 0]).double())
    expected = apply_shape(tiny(), torch.tensor([1.0, 2, 3]).double())
    torch.testing.assert_close(found, expected)


def test_parameters_that_the_body_lacks_are_refused(template: BodyTemplate) -> None:
    with pytest.raises(
        DyngsError, match=r"^betas: 46 numbers given, but the anny body has 44; .*set them to 0$"
    ):
        apply_shape(template, torch.ones(46))
    with pytest.raises(DyngsError, match=r"^expression: 3 numbers given, but the tiny body has 2;"):
        apply_shape(tiny(), None, torch.ones(3).double())


def test_poses_of_another_body_are_refused(template: BodyTemplate) -> None:
    with pytest.raises(
        DyngsError, match=r"^poses must be \(frames, 55, 3\) for the anny body, got \(1, 24, 3\)$"
    ):
        posed_vertices(template, torch.zeros(1, 24, 3), torch.zeros(1, 3))


# --- batches, types, gradients
# ----------------------------------------------------------------------------------------


def test_frames_are_those_one_by_one() -> None:
    """Also when shape and expression change with the frame."""
    body = tiny()
    poses = normal(3, 4, 3)
    trans = normal(3, 3)
    scale = normal(3).exp()
    betas = normal(3, 3)
    expression = normal(3, 2)
    found = posed_vertices(body, poses, trans, betas, expression, scale)
    constant = posed_vertices(body, poses, trans, betas[0], expression[0], scale)
    for f in range(3):
        one = slice(f, f + 1)
        alone = posed_vertices(body, poses[one], trans[one], betas[f], expression[f], scale[one])
        torch.testing.assert_close(found[one], alone)
    torch.testing.assert_close(constant[:1], found[:1])
    assert not torch.allclose(constant[1], found[1])


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


def test_no_frames_are_no_vertices(template: BodyTemplate) -> None:
    assert posed_vertices(template, torch.zeros(0, 55, 3), torch.zeros(0, 3)).shape == (0, 13718, 3)


def test_in_float64_nothing_is_left_in_float32(template: BodyTemplate) -> None:
    body = template.to(dtype=torch.float64)
    poses = 0.3 * normal(1, 55, 3)
    found = posed_vertices(body, poses, normal(1, 3))
    assert found.dtype == torch.float64
    assert body.faces.dtype == torch.long
    assert {
        getattr(body, f.name).dtype
        for f in fields(body)
        if isinstance(getattr(body, f.name), Tensor)
    } == {
        torch.float64,
        torch.long,
    }
    single = posed_vertices(template, poses.float(), normal(1, 3).float())
    torch.testing.assert_close(single.double(), found, rtol=0, atol=1e-6)


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_gradients(size: float) -> None:
    body = tiny()
    given = (size * normal(2, 4, 3), normal(2, 3), normal(3), normal(2, 2), normal(2).exp())
    assert torch.autograd.gradcheck(
        lambda *x: posed_vertices(body, *x), tuple(x.requires_grad_() for x in given)
    )


# --- what does not fit
# ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("weights", torch.zeros(6, 3)),
        ("joints", torch.zeros(5, 3)),
        ("vertices", torch.zeros(6, 2)),
        ("faces", torch.zeros(2, 4).long()),
        ("pose_dirs", torch.zeros(27, 17)),
        ("joint_shape_dirs", torch.zeros(4, 3, 2)),
        ("joint_shape_dirs", None),
        ("uv", torch.zeros(4, 2)),
        ("uv_faces", torch.zeros(3, 3).long()),
        ("parents", (-1, 0, 3, 2)),
    ],
)
def test_parts_that_do_not_fit_each_other_are_refused(name: str, value: object) -> None:
    with pytest.raises(ValueError, match="must"):
        replace(tiny(), **{name: value})


@lru_cache(maxsize=1)
def bare_template() -> tuple[BodyTemplate, np.ndarray, np.ndarray]:
    body = default_template()
    arrays = (x.double().numpy() for x in (body.vertices, body.joints, body.weights))
    vertices, joints, weights = arrays
    return body, *bone_shapes(vertices, joints, body.parents, weights)


def test_both_sides_move_as_mirror_images() -> None:
    _, _, joints = bare_template()
    for name in SIDED:
        left, right = (joints[JOINT_NAMES.index(f"{side}_{name}")] for side in ("left", "right"))
        assert np.array_equal(left * np.array([-1, 1, 1])[:, None], right)


def test_a_bone_moves_all_that_is_below_it_and_nothing_else() -> None:
    _, _, joints = bare_template()
    knee = joints[:, :, 3 * SIDED.index("knee") + 1]
    moved = {name for name, move in zip(JOINT_NAMES, knee, strict=True) if move.any()}
    assert moved == {
        f"{side}_{name}" for side in ("left", "right") for name in ("knee", "ankle", "foot")
    }
    assert knee[JOINT_NAMES.index("left_foot"), 1] == pytest.approx(BONE_UNIT)


def test_the_pelvis_stays_where_it_is() -> None:
    assert not bare_template()[2][0].any()


def test_a_longer_shin_stretches_the_shin_and_carries_the_foot() -> None:
    body, vertices, _ = bare_template()
    ankle = vertices[:, 1, 3 * SIDED.index("ankle") + 1]
    weights = body.weights.numpy()
    foot, head, shin = (
        weights[:, JOINT_NAMES.index(name)] > 0.99 for name in ("left_foot", "head", "left_knee")
    )
    assert ankle[foot] == pytest.approx(BONE_UNIT)
    assert np.abs(ankle[head]).max() == 0
    height = body.vertices.numpy()[shin, 1]
    assert np.corrcoef(height, ankle[shin])[0, 1] < -0.99  # the lower, the more it moves


def test_the_template_has_directions_of_shape_and_of_bones() -> None:
    body, vertices, joints = bare_template()
    assert body.shape_dirs is not None
    assert body.joint_shape_dirs is not None
    assert body.num_shapes == 10 + NUM_BONE_SHAPES
    assert np.allclose(body.shape_dirs[..., 10:].numpy(), vertices, atol=1e-6)
    assert np.allclose(body.joint_shape_dirs[..., 10:].numpy(), joints, atol=1e-6)


def test_directions_of_shape_are_symmetric() -> None:
    body, _, _ = bare_template()
    assert body.joint_shape_dirs is not None
    hips = (
        body.joint_shape_dirs[JOINT_NAMES.index(f"{side}_hip"), :, :10]
        for side in ("left", "right")
    )
    left, right = (x.numpy() for x in hips)
    assert np.allclose(left * np.array([-1, 1, 1])[:, None], right, atol=2e-5)
