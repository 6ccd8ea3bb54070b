"""Gaussians on the texels of the template: where they lie, and which joints they follow.

N Gaussians, J joints.
"""

from __future__ import annotations

from functools import cache

import pytest
import torch
from torch import Tensor

from dyngs.gaussians import Gaussians
from dyngs.human.avatar.posing import (
    FINE_FACTOR,
    Anchors,
    skinning_weights,
    surface_gaussians,
    surface_texels,
    texel_gaussians,
)
from dyngs.human.body.atlas import atlas_texels
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.ops.quaternions import rotation_matrices

RESOLUTION = 48


@cache
def person(sh_degree: int = 0) -> tuple[BodyTemplate, Gaussians, Anchors, Tensor]:
    """The free template with one scaffold, and its dense weights."""
    body = default_template()
    gaussians, anchors = texel_gaussians(atlas_texels(body, RESOLUTION), (0.0, 0.02), sh_degree)
    generator = torch.Generator().manual_seed(0)
    gaussians = gaussians.replace(sh=0.3 * torch.randn(gaussians.sh.shape, generator=generator))
    return body, gaussians, anchors, skinning_weights(anchors, len(body.joints))


def test_corrections_act_only_where_parts_meet() -> None:
    _, _, anchors, weights = person()
    generator = torch.Generator().manual_seed(3)
    corrections = torch.randn(anchors.weights.shape, generator=generator)
    found = skinning_weights(anchors, weights.shape[1], corrections)
    torch.testing.assert_close(found.sum(1), torch.ones(len(found)))
    alone = anchors.weights[:, 0] == 1
    assert bool(alone.any())
    torch.testing.assert_close(found[alone], weights[alone])
    assert bool(((found > 0) <= (weights > 0)).all()), "no joint is followed that was not"
    assert float((found - weights)[~alone].abs().max()) > 0.1


def test_gradients_by_corrections_are_those_of_the_formula() -> None:
    """A joint may be named twice, as files may have it: its weights add up."""
    points = torch.zeros(2, 3, dtype=torch.float64)
    joints = torch.tensor([[2, 0, 1], [1, 1, 3]])
    weights = torch.tensor([[0.5, 0.3, 0.2], [0.7, 0.3, 0.0]], dtype=torch.float64)
    anchors = Anchors(
        points, points[:, 0], joints, weights, joints[:, 0], points, points[:, :2], points[:, 0]
    )
    corrections = torch.tensor(
        [[0.3, -1.0, 0.2], [0.5, 0.0, 2.0]], dtype=torch.float64, requires_grad=True
    )
    found = skinning_weights(anchors, 4, corrections).detach()
    parts = torch.softmax(weights.log() + corrections.detach(), 1)
    torch.testing.assert_close(
        found[0], torch.stack([parts[0, 1], parts[0, 2], parts[0, 0], torch.zeros(())])
    )
    torch.testing.assert_close(found[1].tolist(), [0.0, 1.0, 0.0, 0.0])
    assert torch.autograd.gradcheck(lambda c: skinning_weights(anchors, 4, c), corrections)


def test_first_gaussians_lie_flat_on_their_scaffolds() -> None:
    texels = atlas_texels(default_template(), RESOLUTION)
    gaussians, anchors = texel_gaussians(texels, (0.0, 0.03), 1)
    assert len(gaussians) == len(anchors) == 2 * len(texels)
    torch.testing.assert_close(
        gaussians.means[len(texels) :], texels.points + 0.03 * texels.normals
    )
    thin = rotation_matrices(gaussians.quats)[:, :, 2]
    torch.testing.assert_close(thin[: len(texels)], texels.normals, rtol=0, atol=1e-5)
    assert gaussians.log_scales.argmin(1).eq(2).all()
    assert gaussians.opacities[0] > 0.5 > gaussians.opacities[-1]
    assert gaussians.sh.shape == (2 * len(texels), 4, 3)


FINE = 64


def test_hands_and_feet_have_smaller_texels_of_the_same_surface_where_pixels_are_small() -> None:
    body = default_template()
    plain = atlas_texels(body, FINE)
    coarse, fine = surface_texels(body, FINE, body.vertices, 0.002)
    assert fine.resolution == FINE_FACTOR * coarse.resolution
    parts = {JOINT_NAMES[i] for i in fine.weights.argmax(1).unique().tolist()}
    assert {"left_wrist", "right_index3", "left_foot", "right_ankle"} <= parts
    assert not parts & {"head", "spine3", "left_elbow", "left_knee", "left_eye"}
    assert len(coarse) < len(plain)
    areas = [
        float(sum(texels.size.square().sum() for texels in x)) for x in ((plain,), (coarse, fine))
    ]
    assert areas[1] == pytest.approx(areas[0], rel=0.03)
    gaussians, anchors, normals = surface_gaussians([coarse, fine], 0)
    assert len(gaussians) == len(anchors) == len(normals) == len(coarse) + len(fine)
    assert torch.equal(anchors.points, torch.cat([coarse.points, fine.points]))
    assert torch.equal(normals, torch.cat([coarse.normals, fine.normals]))


def test_scaffolds_are_displaced_by_exactly_their_height() -> None:
    body = default_template()
    heights = (0.0, 0.01, 0.04)
    texels = atlas_texels(body, 64, body.vertices)
    _, anchors = texel_gaussians(texels, heights, 0)
    for k, height in enumerate(heights):
        rows = slice(k * len(texels), (k + 1) * len(texels))
        assert anchors.height[rows].tolist() == pytest.approx([height] * len(texels))
        apart = (anchors.points[rows] - texels.points).double()
        torch.testing.assert_close(apart, height * texels.normals.double(), rtol=0, atol=2e-7)
    assert torch.equal(anchors.points[: len(texels)], texels.points)
