"""Cameras as tensors: shapes, centres, selection."""

from __future__ import annotations

import pytest
import torch
from scenes import look_around

from dyngs.core.camera import Cameras


def three_cameras() -> Cameras:
    return Cameras(look_around(3), torch.eye(3, dtype=torch.float64).repeat(3, 1, 1), 20, 10)


def test_centers_are_where_the_camera_sees_the_origin() -> None:
    cameras = three_cameras()
    homogeneous = torch.cat([cameras.centers, torch.ones(3, 1, dtype=torch.float64)], 1)
    seen = (cameras.cam_from_world @ homogeneous[..., None])[..., 0]
    torch.testing.assert_close(seen, torch.tensor([0.0, 0, 0, 1]).double().expand(3, 4))


def test_select_is_a_batch_of_one() -> None:
    one = three_cameras().select(1)
    assert len(one) == 1
    assert torch.equal(one.cam_from_world[0], look_around(3)[1])
    assert (one.width, one.height) == (20, 10)


def test_to_changes_the_precision_of_both_matrices() -> None:
    cameras = three_cameras().to(dtype=torch.float32)
    assert cameras.cam_from_world.dtype == cameras.intrinsics.dtype == torch.float32


@pytest.mark.parametrize(
    ("poses", "intrinsics", "size", "message"),
    [
        ((4, 4), (1, 3, 3), (8, 8), r"cam_from_world must be \(V, 4, 4\), got \(4, 4\)"),
        ((2, 3, 4), (2, 3, 3), (8, 8), r"cam_from_world must be"),
        ((2, 4, 4), (1, 3, 3), (8, 8), r"intrinsics must be \(V, 3, 3\), got \(1, 3, 3\)"),
        ((2, 4, 4), (2, 3, 3), (0, 8), "image size must be positive, in whole pixels, got 0x8"),
        ((2, 4, 4), (2, 3, 3), (8, 7.5), "image size must be positive, in whole pixels, got 8x7.5"),
        (
            (2, 4, 4),
            (2, 3, 3),
            (float("nan"), 8),
            "image size must be positive, in whole pixels, got nanx8",
        ),
    ],
)
def test_wrong_shapes_are_named(
    poses: tuple, intrinsics: tuple, size: tuple[int, int], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Cameras(torch.zeros(poses), torch.zeros(intrinsics), *size)
