"""The picture of an avatar from four sides."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dyngs.human.avatar.picture import avatar_picture
from dyngs.human.avatar.posing import Skeleton, texel_gaussians
from dyngs.human.avatar.scene import initial_human_scene
from dyngs.human.body.atlas import atlas_texels
from dyngs.human.body.body_reader import default_template
from dyngs.human.motion.motion import MotionClip


@pytest.fixture(scope="module")
def sheet() -> np.ndarray:
    """Somebody red in front, blue behind, brighter on the left, who lies on the floor."""
    body = default_template()
    gaussians, anchors = texel_gaussians(atlas_texels(body, 32), (0.0,), 0)
    colours = torch.full_like(gaussians.sh, -1.5)
    front = gaussians.means[:, 2] > 0
    colours[front, :, 0] = 1.5
    colours[~front, :, 2] = 1.5
    colours[gaussians.means[:, 0] > 0, :, 1] = 1.0
    solid = gaussians.replace(
        sh=colours, logit_opacities=torch.full_like(gaussians.logit_opacities, 6.0)
    )
    lying = torch.zeros(1, 55, 3)
    lying[0, 0, 0] = -1.5
    clip = MotionClip(
        torch.zeros(1, dtype=torch.float64), lying, torch.ones(1, 3), 2 * torch.ones(1)
    )
    scene = initial_human_scene(solid, anchors, Skeleton(body.joints, body.parents), clip)
    return avatar_picture(scene)


def test_the_rest_pose_is_seen_upright_from_four_sides(sheet: np.ndarray) -> None:
    width = (sheet.shape[1] - 6) // 4
    cells = [sheet[22:, 6 + i * width : i * width + width].astype(float) for i in range(4)]
    for cell in cells:
        seen = (cell.min(-1) < 128).nonzero()
        assert np.ptp(seen[0]) > 250
        assert 150 < np.median(seen[1]) < 250
    middle = [cell[150:200, 170:230].mean((0, 1)) for cell in cells]
    assert middle[0][0] > middle[0][2], "front"
    assert middle[2][2] > middle[2][0], "back"
    assert middle[1][1] > middle[3][1], "the left side is the brighter one"
    left_of_person = cells[0][150:200, 200:230, 1].mean()
    assert left_of_person > cells[0][150:200, 170:200, 1].mean(), "on the right of the picture"
