"""Hands and feet on smaller texels: only there, only where pixels are small, as much surface as before."""

from __future__ import annotations

import pytest
import torch

from dyngs.camera import Cameras
from dyngs.human.avatar.fine_limbs import FINER, pixel_size, surface_gaussians, surface_texels
from dyngs.human.motion.clip import MotionClip
from dyngs.human.template.atlas import atlas_texels
from dyngs.human.template.joints import JOINT_NAMES
from dyngs.human.template.load import default_template

RESOLUTION = 64


def test_hands_and_feet_have_smaller_texels_of_the_same_surface_where_pixels_are_small() -> None:
    body = default_template()
    plain = atlas_texels(body, RESOLUTION)
    coarse, fine = surface_texels(body, RESOLUTION, body.vertices, 0.002)
    assert fine.resolution == FINER * coarse.resolution
    parts = {JOINT_NAMES[i] for i in fine.weights.argmax(1).unique().tolist()}
    assert {"left_wrist", "right_index3", "left_foot", "right_ankle"} <= parts
    assert not parts & {"head", "spine3", "left_elbow", "left_knee", "left_eye"}
    assert len(coarse) < len(plain)
    areas = [float(sum(texels.size.square().sum() for texels in x)) for x in ((plain,), (coarse, fine))]
    assert areas[1] == pytest.approx(areas[0], rel=0.03)
    gaussians, anchors, normals = surface_gaussians([coarse, fine], [0.0, 0.02], 0)
    assert len(gaussians) == len(anchors) == len(normals) == 2 * (len(coarse) + len(fine))
    lowest = anchors.height == 0
    torch.testing.assert_close(anchors.points[~lowest], anchors.points[lowest] + 0.02 * normals[lowest])


def test_nothing_is_finer_where_a_texel_is_hardly_wider_than_a_pixel() -> None:
    body = default_template()
    (only,) = surface_texels(body, RESOLUTION, body.vertices, 0.05)
    assert torch.equal(only.index, atlas_texels(body, RESOLUTION).index)


def test_a_pixel_is_as_large_on_the_person_as_the_camera_is_far() -> None:
    pose, clip = (
        torch.eye(4),
        MotionClip(torch.zeros(1, dtype=torch.float64), torch.zeros(1, 55, 3), torch.zeros(1, 3), torch.tensor([2.0])),
    )
    pose[2, 3] = 8.0
    camera = Cameras(pose[None], torch.tensor([[[400.0, 0, 50], [0, 400.0, 50], [0, 0, 1]]]), 100, 100)
    assert pixel_size([camera], clip, torch.zeros(3)) == pytest.approx(8.0 / 400 / 2)
    assert pixel_size([], clip, torch.zeros(3)) == torch.inf
