"""First points in the visual hull of an object."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dyngs.capture.first_points import with_first_points
from dyngs.capture.silhouettes import ENOUGH, points_in_silhouettes
from dyngs.config import DataConfig, PointsInit
from dyngs.data.capture import View
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import StillOptions, write_still_capture
from dyngs.io.write import write_image

RADIUS, FOCAL, SIDE, DISTANCE = 0.4, 60.0, 64, 4.0
HALF_SIDE = 1.3  # of the cube in which points are drawn


def _views(folder: Path, alpha: float = 0.0) -> list[View]:
    """An orange ball around the origin from the six sides of a cube; ``alpha`` is that of the
    background."""
    views = []
    rows, columns = np.mgrid[:SIDE, :SIDE] + 0.5 - SIDE / 2
    rays = np.stack([columns / FOCAL, rows / FOCAL, np.ones_like(rows)], axis=-1)
    nearest = DISTANCE * np.sqrt(1 - (rays[..., 2] / np.linalg.norm(rays, axis=-1)) ** 2)
    image = np.zeros((SIDE, SIDE, 4), np.float32)
    image[...] = (0, 0, 0, alpha)
    image[nearest < RADIUS] = (1.0, 0.5, 0.0, 1.0)
    intrinsics = np.array([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]])
    for i in range(6):
        axis = np.eye(3)[i // 2] * (1 if i % 2 else -1)
        turn = np.eye(4)
        turn[:3, :3] = np.stack(
            [np.roll(np.abs(axis), 1), np.cross(axis, np.roll(np.abs(axis), 1)), axis]
        )
        turn[2, 3] = DISTANCE
        path = folder / f"{i}.png"
        write_image(path, image)
        views.append(View(path.stem, path, turn, intrinsics, SIDE, SIDE))
    return views


def test_points_lie_in_the_ball_with_its_colour(tmp_path: Path) -> None:
    views = _views(tmp_path)
    found = points_in_silhouettes(views, DataConfig(root=tmp_path), 10_000, HALF_SIDE)
    assert found is not None
    # The hull of six views is larger than the ball, up to the corners of the cube around it; a
    # pixel is 1/15.
    assert np.abs(found.xyz).max() < RADIUS * 1.15 + 1 / 15
    assert np.linalg.norm(found.xyz, axis=1).max() < RADIUS * 3**0.5
    assert (found.rgb == (255, 128, 0)).all()
    assert len(found.xyz) >= ENOUGH, "150 of 10,000 in the cube lie in the hull: more were drawn"
    again = points_in_silhouettes(views, DataConfig(root=tmp_path), 10_000, HALF_SIDE)
    assert again is not None
    assert np.array_equal(found.xyz, again.xyz)


def test_images_without_silhouettes_say_nothing(tmp_path: Path) -> None:
    assert (
        points_in_silhouettes(
            _views(tmp_path, alpha=1.0), DataConfig(root=tmp_path), 500, HALF_SIDE
        )
        is None
    )


def test_silhouettes_that_hold_nothing_or_most_say_nothing(tmp_path: Path) -> None:
    views = _views(tmp_path)
    options = DataConfig(root=tmp_path)
    assert points_in_silhouettes(views, options, 500, 1e-3) is None, "the whole cube is inside"
    for view in views[:2]:
        write_image(view.image_path, np.zeros((SIDE, SIDE, 4), np.float32))
    assert points_in_silhouettes(views, options, 500, HALF_SIDE) is None


def test_a_still_blender_scene_begins_in_its_silhouettes(tmp_path: Path) -> None:
    root = write_still_capture(
        tmp_path / "still", StillOptions(size=32, num_train=8, num_test=1, samples=1)
    )
    capture = read_capture(root)
    begun, lines = with_first_points(capture, DataConfig(root=root), PointsInit())
    assert begun.points is not None
    assert lines == [
        f"{len(begun.points.xyz):,} first points were drawn at random in the silhouettes of the images"
    ]
