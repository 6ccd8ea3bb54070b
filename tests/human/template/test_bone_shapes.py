"""Directions of bones: known moves of joints and vertices of the free template."""

from functools import lru_cache

import numpy as np
import pytest

from dyngs.human.template.body import BodyTemplate
from dyngs.human.template.bone_shapes import BONE_UNIT, NUM_BONE_SHAPES, SIDED, bone_shapes
from dyngs.human.template.joints import JOINT_NAMES
from dyngs.human.template.load import default_template


@lru_cache(maxsize=1)
def template() -> tuple[BodyTemplate, np.ndarray, np.ndarray]:
    body = default_template()
    arrays = (x.double().numpy() for x in (body.vertices, body.joints, body.weights))
    vertices, joints, weights = arrays
    return body, *bone_shapes(vertices, joints, body.parents, weights)


def test_both_sides_move_as_mirror_images() -> None:
    _, _, joints = template()
    for name in SIDED:
        left, right = (joints[JOINT_NAMES.index(f"{side}_{name}")] for side in ("left", "right"))
        assert np.array_equal(left * np.array([-1, 1, 1])[:, None], right)


def test_a_bone_moves_all_that_is_below_it_and_nothing_else() -> None:
    _, _, joints = template()
    knee = joints[:, :, 3 * SIDED.index("knee") + 1]
    moved = {name for name, move in zip(JOINT_NAMES, knee, strict=True) if move.any()}
    assert moved == {f"{side}_{name}" for side in ("left", "right") for name in ("knee", "ankle", "foot")}
    assert knee[JOINT_NAMES.index("left_foot"), 1] == pytest.approx(BONE_UNIT)


def test_the_pelvis_stays_where_it_is() -> None:
    assert not template()[2][0].any()


def test_a_longer_shin_stretches_the_shin_and_carries_the_foot() -> None:
    body, vertices, _ = template()
    ankle = vertices[:, 1, 3 * SIDED.index("ankle") + 1]
    weights = body.weights.numpy()
    foot, head, shin = (weights[:, JOINT_NAMES.index(name)] > 0.99 for name in ("left_foot", "head", "left_knee"))
    assert ankle[foot] == pytest.approx(BONE_UNIT)
    assert np.abs(ankle[head]).max() == 0
    height = body.vertices.numpy()[shin, 1]
    assert np.corrcoef(height, ankle[shin])[0, 1] < -0.99  # the lower, the more it moves


def test_the_template_has_directions_of_shape_and_of_bones() -> None:
    body, vertices, joints = template()
    assert body.shape_dirs is not None
    assert body.joint_shape_dirs is not None
    assert body.num_shapes == 10 + NUM_BONE_SHAPES
    assert np.allclose(body.shape_dirs[..., 10:].numpy(), vertices, atol=1e-6)
    assert np.allclose(body.joint_shape_dirs[..., 10:].numpy(), joints, atol=1e-6)


def test_directions_of_shape_are_symmetric() -> None:
    body, _, _ = template()
    assert body.joint_shape_dirs is not None
    hips = (body.joint_shape_dirs[JOINT_NAMES.index(f"{side}_hip"), :, :10] for side in ("left", "right"))
    left, right = (x.numpy() for x in hips)
    assert np.allclose(left * np.array([-1, 1, 1])[:, None], right, atol=2e-5)
