"""Cameras written as transforms.json come back as they were: poses, lenses, times, points,
splits."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dyngs.config import DataConfig
from dyngs.data.capture import Capture, Lens, PointCloud
from dyngs.data.read import read_capture
from dyngs.export.cameras import NAME, write_cameras

LENSES = [
    Lens(),
    Lens("opencv", (0.1, -0.02, 0.001, 0.002)),
    Lens("opencv", (0.1,) * 8),
    Lens("fisheye", (0.01,) * 4, 1.5),
]


@pytest.fixture
def capture(still: Path) -> Capture:
    """A capture whose world is far away, with a lens of another kind for each of its first
    views."""
    found = read_capture(still)
    random = np.random.default_rng(0)
    views = [
        replace(
            view, lens=LENSES[i % 4], camera_id=i, mask_path=view.image_path if i == 1 else None
        )
        for i, view in enumerate(found.splits["train"])
    ]
    cloud = PointCloud(random.normal(size=(5, 3)), random.integers(0, 255, (5, 3)).astype(np.uint8))
    splits = {**found.splits, "train": tuple(views)}
    return replace(
        found, splits=splits, points=cloud, world_offset=np.array([10.0, 0, -20]), span=(2.0, 4.0)
    )


def test_a_written_capture_is_read_as_it_was(capture: Capture, tmp_path: Path) -> None:
    write_cameras(tmp_path / "out" / NAME, capture, capture.splits)
    back = read_capture(DataConfig(root=tmp_path / "out", follow_links=True))
    assert {split: len(views) for split, views in back.splits.items()} == {
        split: len(views) for split, views in capture.splits.items()
    }
    assert back.points is not None
    assert capture.points is not None
    np.testing.assert_allclose(back.points.xyz, capture.points.xyz + capture.world_offset)
    np.testing.assert_array_equal(back.points.rgb, capture.points.rgb)
    views = {view.image_path.resolve(): view for view in back.splits["train"]}
    for view in capture.splits["train"]:
        same = views[view.image_path.resolve()]
        centre = -view.cam_from_world[:3, :3].T @ view.cam_from_world[:3, 3] + capture.world_offset
        np.testing.assert_allclose(
            -same.cam_from_world[:3, :3].T @ same.cam_from_world[:3, 3], centre, atol=1e-9
        )
        np.testing.assert_allclose(
            same.cam_from_world[:3, :3], view.cam_from_world[:3, :3], atol=1e-9
        )
        np.testing.assert_allclose(
            same.intrinsics, view.intrinsics @ np.diag([view.lens.focal_ratio] * 2 + [1.0])
        )
        assert (same.lens, same.camera_id) == (replace(view.lens, focal_ratio=1.0), view.camera_id)
        assert (same.mask_path is None) == (view.mask_path is None)


def test_times_are_those_of_the_files(capture: Capture, tmp_path: Path) -> None:
    views = [replace(view, time=i / 10) for i, view in enumerate(capture.splits["train"])]
    path = write_cameras(tmp_path / NAME, capture, {"train": views})
    times = [frame["time"] for frame in json.loads(path.read_text())["frames"]]
    np.testing.assert_allclose(times, [2 + 2 * i / 10 for i in range(len(times))])
