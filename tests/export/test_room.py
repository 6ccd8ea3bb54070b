"""Images are enlarged where a person moves out of them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dyngs.core.camera import Cameras
from dyngs.export.camera_paths import CameraPath
from dyngs.export.choose_path import MOST_ROOM, _with_room, framing_points
from tests.human.avatar.test_scene import stirred


def camera(size: int) -> Cameras:
    pose = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    pose[2, 3] = 6.0
    intrinsics = torch.tensor([[100.0, 0, size / 2], [0, 100.0, size / 2], [0, 0, 1]])
    return Cameras(pose[None].expand(2, 4, 4), intrinsics.expand(2, 3, 3).clone(), size, size)


@pytest.mark.parametrize(("shift", "size"), [(0.0, 100), (3.0, 100), (-3.0, 100), (0.0, 20)])
def test_a_person_who_leaves_the_image_makes_it_larger(shift: float, size: int) -> None:
    scene = stirred()
    moved = scene.clip.trans.clone()
    moved[-1, 0] += shift
    scene = replace(scene, clip=replace(scene.clip, trans=moved))
    before = camera(size)
    after = _with_room(scene, CameraPath(before, times=(0.0, 1.0)))
    assert size <= after.width <= MOST_ROOM * size
    assert (after.width > size) == (shift != 0 or size == 20)
    offset = after.intrinsics[0, :2, 2] - before.intrinsics[0, :2, 2]
    assert torch.equal(offset, offset.round()), "pixels keep their rays"
    if size == 100:
        for row, time in enumerate((0.0, 1.0)):
            points = framing_points(scene, time)
            local = points @ after.cam_from_world[row, :3, :3].T + after.cam_from_world[row, :3, 3]
            pixels = local @ after.intrinsics[row].T
            columns = pixels[:, 0] / pixels[:, 2]
            assert float(((columns >= 0) & (columns <= after.width)).float().mean()) > 0.97
