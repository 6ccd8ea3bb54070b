"""Cameras as tensors: shapes, centres, selection."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import look_around

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError


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


def test_matrices_of_both_conventions_give_the_same_cameras() -> None:
    opencv = np.stack([np.linalg.inv(pose) for pose in look_around(3).numpy()])
    opengl = opencv @ np.diag([1, -1, -1, 1])
    wanted = three_cameras()
    for poses, convention in ((opencv, "opencv"), (opengl.tolist(), "opengl")):
        found = Cameras.from_matrices(poses, np.eye(3), 20, 10, convention=convention)
        torch.testing.assert_close(found.cam_from_world, wanted.cam_from_world)
        assert [one.width for one in found] == [20, 20, 20]
    array = Cameras(wanted.cam_from_world.numpy(), [[[1, 0, 0], [0, 1, 0], [0, 0, 1]]] * 3, 20, 10)
    assert torch.equal(array.intrinsics, wanted.intrinsics)
    with pytest.raises(DyngsError, match=r"\(V, 4, 4\) and finite, got \(3, 4\)"):
        Cameras.from_matrices(np.eye(4)[:3], np.eye(3), 20, 10)
