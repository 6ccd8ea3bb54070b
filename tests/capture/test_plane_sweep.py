"""Dense first points by plane sweep: on a tilted, textured plane whose depth is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dyngs.capture import initial_points
from dyngs.capture.initial_points import create_initial_points
from dyngs.capture.plane_sweep import (
    points_from_depth_maps,
    sweep_dense_points,
)
from dyngs.config import DataConfig, PointsInit
from dyngs.data.capture import Capture, View
from dyngs.io.write import write_image

WIDTH, HEIGHT, FOCAL, SLOPE, DISTANCE = 64, 48, 66.0, 0.3, 4.0
INTRINSICS = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
_ACROSS = np.linspace(-1, 1, 60)
# on the plane z = SLOPE x
SPARSE = np.stack([_ACROSS, 0.6 * np.sin(9 * _ACROSS), SLOPE * _ACROSS], axis=1)


def _colour(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A texture without repetition, (..., 3) in [0, 1]."""
    waves = [
        np.sin(a * x + b * y + c)
        for a, b, c in ((9, 4, 0), (-5, 13, 1), (17, 8, 2), (7, -19, 3), (2, 3, 4))
    ]
    grey = 0.5 + 0.09 * np.sum(waves, axis=0)
    return np.stack([grey, 0.8 * grey, 0.5 * grey + 0.2], axis=-1)


def _views(folder: Path, count: int = 7, contrast: float = 1.0, unit: float = 1.0) -> list[View]:
    """Cameras on an arc of 8 degrees each around the plane's middle, with depth maps in a unit."""
    views = []
    down, across = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([across, down, np.ones_like(down)], axis=-1) @ np.linalg.inv(INTRINSICS).T
    for i in range(count):
        angle = np.radians(8 * (i - count // 2))
        pose = np.eye(4)
        pose[:3, :3] = [
            [np.cos(angle), 0, -np.sin(angle)],
            [0, 1, 0],
            [np.sin(angle), 0, np.cos(angle)],
        ]
        pose[2, 3] = DISTANCE
        center = -pose[:3, :3].T @ pose[:3, 3]
        lines = rays @ pose[:3, :3]
        depth = (SLOPE * center[0] - center[2]) / (lines[..., 2] - SLOPE * lines[..., 0])
        x, y = (center[k] + depth * lines[..., k] for k in (0, 1))
        path = folder / f"{i}.png"
        write_image(path, (0.5 + contrast * (_colour(x, y) - 0.5)).astype(np.float32))
        np.save(path.with_suffix(".npy"), depth / unit)
        views.append(
            View(
                path.stem,
                path,
                pose,
                INTRINSICS,
                WIDTH,
                HEIGHT,
                depth_path=path.with_suffix(".npy"),
            )
        )
    return views


def test_points_lie_on_the_plane_in_its_colours(tmp_path: Path) -> None:
    views = _views(tmp_path)
    options = DataConfig(root=tmp_path)
    found = sweep_dense_points(views, options, SPARSE, 100_000)
    assert found is not None
    assert len(found.xyz) > 0.5 * len(views) * WIDTH * HEIGHT
    x, y, z = found.xyz.T
    error = np.abs(z - SLOPE * x)
    assert np.median(error) < 0.002 * DISTANCE, (
        "depths between those that are tried are interpolated"
    )
    assert np.quantile(error, 0.95) < 0.02 * DISTANCE
    assert np.abs(found.rgb / 255 - _colour(x, y)).mean() < 0.02
    few = sweep_dense_points(views, options, SPARSE, 50)
    assert few is not None
    assert len(few.xyz) == 50


def test_given_depth_maps_have_points_where_they_agree(tmp_path: Path) -> None:
    views = _views(tmp_path)
    options = DataConfig(root=tmp_path)
    wrong = np.load(tmp_path / "3.npy")
    wrong[:, : WIDTH // 2] *= 1.2
    np.save(tmp_path / "3.npy", wrong)
    found = points_from_depth_maps(views, options, 100_000)
    assert found is not None
    assert len(found.xyz) > 0.7 * len(views) * WIDTH * HEIGHT
    x, y, z = found.xyz.T
    np.testing.assert_allclose(z, SLOPE * x, atol=1e-5 * DISTANCE)
    assert np.abs(found.rgb - 255 * _colour(x, y)).max() < 3
    few = points_from_depth_maps(views, options, 1000)
    assert few is not None
    assert len(few.xyz) == 1000


def test_depth_maps_in_another_unit_have_none(tmp_path: Path) -> None:
    options = DataConfig(root=tmp_path)
    assert points_from_depth_maps(_views(tmp_path, unit=2.0), options, 1000) is None
    plain = [replace(view, depth_path=None) for view in _views(tmp_path)]
    assert points_from_depth_maps(plain, options, 1000) is None


def test_a_still_capture_without_any_points_is_swept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Random points bound the depth range; untextured pixels take the depth of their neighbours."""
    monkeypatch.setattr(initial_points, "triangulate_from_views", lambda *_: None)
    views = [replace(view, depth_path=None) for view in _views(tmp_path)]
    capture = Capture(tmp_path, "nerfstudio", {"train": tuple(views)})
    begun, lines = create_initial_points(capture, DataConfig(root=tmp_path), PointsInit(dense=2000))
    assert begun.points is not None
    assert len(begun.points.xyz) == 2000
    assert lines == ["2,000 initial points from plane-sweep depth maps (init.dense)"]
    x, _, z = begun.points.xyz.T
    error = np.abs(z - SLOPE * x)
    assert np.median(error) < 0.01 * DISTANCE
    assert np.quantile(error, 0.9) < 0.05 * DISTANCE
    assert (
        create_initial_points(capture, DataConfig(root=tmp_path), PointsInit(dense=0))[0].points
        is None
    )
    timed = capture.replace(
        splits={"train": tuple(replace(view, time=0.1 * i) for i, view in enumerate(views))}
    )
    assert (
        create_initial_points(timed, DataConfig(root=tmp_path), PointsInit(dense=2000))[0].points
        is None
    )


def test_any_number_of_threads_finds_the_same_points(tmp_path: Path) -> None:
    views = _views(tmp_path, 4)
    options = DataConfig(root=tmp_path)
    before = torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(sweep_dense_points(views, options, SPARSE, 1000))
    finally:
        torch.set_num_threads(before)
    first = found[0]
    assert first is not None
    assert all(
        x is not None and np.array_equal(x.xyz, first.xyz) and np.array_equal(x.rgb, first.rgb)
        for x in found
    )


@pytest.mark.parametrize(
    "fault", ["no texture", "wrong poses", "one view", "the same view", "no points seen"]
)
def test_without_evidence_there_are_no_points(tmp_path: Path, fault: str) -> None:
    views = _views(tmp_path, contrast=0.0 if fault == "no texture" else 1.0)
    sparse = SPARSE
    if fault == "wrong poses":
        tilts = np.radians([9, -7, 4, -11, 8, -5, 10])  # about the axis across the image
        turns = [
            np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
            for a in tilts
        ]
        wrong = [
            np.block([[turn, np.zeros((3, 1))], [np.zeros((1, 3)), np.eye(1)]]) for turn in turns
        ]
        views = [
            replace(v, cam_from_world=turn @ v.cam_from_world)
            for v, turn in zip(views, wrong, strict=True)
        ]
    elif fault == "one view":
        views = views[:1]
    elif fault == "the same view":
        views = [views[0]] * 5
    elif fault == "no points seen":
        sparse = SPARSE - (0, 0, 100)
    assert sweep_dense_points(views, DataConfig(root=tmp_path), sparse, 1000) is None
