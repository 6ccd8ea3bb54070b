"""Nerfies and HyperNeRF folders."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny_captures import (
    SIDE_PIXELS,
    edit_json,
    pixel_of,
    random_pixels,
    write_image,
    write_nerfies,
)

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture
from dyngs.data.images.lens import distort
from dyngs.data.readers.nerfies import read_nerfies


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_nerfies(tmp_path)


def read(root: Path, **options: Any) -> Capture:
    return read_capture(DataConfig.model_validate({"root": root, **options}))


def test_views_times_and_splits(root: Path) -> None:
    capture = read(root)
    assert (capture.format, capture.warnings, capture.points) == ("nerfies", (), None)
    found = {
        split: [(view.name, view.time, view.frame, view.camera_id) for view in views]
        for split, views in capture.splits.items()
    }
    assert found == {
        "train": [("000000", 0.0, 0, 0), ("000002", 0.4, 2, 0), ("000004", 0.8, 4, 0)],
        "test": [("000001", 0.2, 1, 1), ("000003", 0.6, 3, 1), ("000005", 1.0, 5, 1)],
        "val": [],
    }


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_known_points_at_known_pixels(tmp_path: Path, factor: int) -> None:
    """Project points in the scaled frame of scene.json, with intrinsics of the available images."""
    capture = read(write_nerfies(tmp_path, factor=factor))
    view = capture.splits["train"][0]
    assert (view.width, view.height, capture.warnings) == (16, 12, ())
    assert f"{factor}x" in view.image_path.parts
    for point, pixel in SIDE_PIXELS:
        assert pixel_of(view, point) == pytest.approx(pixel)


def test_the_largest_images_are_taken(tmp_path: Path) -> None:
    write_nerfies(tmp_path, factor=2)
    (tmp_path / "rgb" / "1x").mkdir()
    for i in range(6):
        write_image(tmp_path / f"rgb/16x/{i:06d}.png", random_pixels(2, 1, 3))
    assert {view.width for view in read(tmp_path).splits["train"]} == {16}


def test_odd_sizes_are_rounded_either_way(tmp_path: Path) -> None:
    write_nerfies(tmp_path, factor=2)
    for path in (tmp_path / "camera").iterdir():
        edit_json(path, lambda camera: camera.update(image_size=[33, 25]))
    capture = read(tmp_path)
    assert capture.warnings == ()
    assert capture.splits["train"][0].intrinsics[0, 0] == pytest.approx(40 * 16 / 33)


def test_points_are_in_the_frame_of_the_poses(root: Path) -> None:
    xyz = np.array([[1.0, -2.0, 0.5], [5.0, -2.0, 0.5], [np.nan, 0, 0]])
    np.save(root / "points.npy", xyz)
    capture = read(root)
    assert capture.points is not None
    assert capture.points.xyz == pytest.approx(np.array([[0.0, 0, 0], [1, 0, 0]]))
    assert (capture.points.rgb == 128).all()
    assert capture.warnings == ("1 points with NaN, infinite or huge coordinates are ignored",)


def test_lens_and_aspect(root: Path) -> None:
    change = {"radial_distortion": [0.1, 0.02, 0.003], "tangential_distortion": [0.01, -0.02]}
    edit_json(
        root / "camera" / "000000.json",
        lambda c: c.update(change, pixel_aspect_ratio=1.5),
    )
    capture = read(root)
    view = capture.splits["train"][0]
    assert view.lens.model == "opencv"
    assert view.lens.params == (0.1, 0.02, 0.01, -0.02, 0.003)
    assert view.intrinsics[1, 1] == pytest.approx(30)
    x = 0.3
    y = -0.2  # Nerfies' formula, written out
    r2 = x * x + y * y
    radial = 1 + r2 * (0.1 + r2 * (0.02 + r2 * 0.003))
    expected = (
        x * radial + 2 * 0.01 * x * y - 0.02 * (r2 + 2 * x * x),
        y * radial - 2 * 0.02 * x * y + 0.01 * (r2 + 2 * y * y),
    )
    point = torch.tensor([[x, y]], dtype=torch.float64)
    assert distort(view.lens, point)[0].tolist() == pytest.approx(expected)


def test_without_validation_ids_every_nth_is_held_out(root: Path) -> None:
    edit_json(root / "dataset.json", lambda c: c.update(val_ids=[], train_ids=c["ids"]))
    capture = read(root, test_every=3)
    assert [view.name for view in capture.splits["test"]] == ["000002", "000003"]
    assert len(capture.splits["train"]) == 4


def test_time_id_and_no_times(root: Path) -> None:
    times = [view.time for view in read(root).splits["train"]]
    edit_json(
        root / "metadata.json", lambda c: [m.update(time_id=m.pop("warp_id")) for m in c.values()]
    )
    assert [view.time for view in read(root).splits["train"]] == times
    edit_json(root / "metadata.json", lambda c: [m.pop("time_id") for m in c.values()])
    assert {view.time for view in read(root).splits["train"]} == {None}
    edit_json(root / "metadata.json", lambda c: c["000001"].update(warp_id=3))
    with pytest.raises(DyngsError, match=r"time of .* must be a finite number"):
        read(root)


def test_one_time_is_a_still_scene(root: Path) -> None:
    edit_json(root / "metadata.json", lambda c: [m.update(warp_id=0) for m in c.values()])
    capture = read(root)
    assert {view.time for view in capture.splits["train"]} == {None}
    assert "treated as a static scene" in capture.warnings[0]


def test_frames_are_chosen(root: Path) -> None:
    capture = read(root, frames="2:5")
    assert [(view.name, view.time) for view in capture.splits["train"]] == [
        ("000002", 0.0),
        ("000004", 1.0),
    ]
    assert [(view.name, view.time) for view in capture.splits["test"]] == [
        ("000003", pytest.approx(0.5))
    ]


@pytest.mark.parametrize(
    ("file", "change", "line"),
    [
        ("dataset.json", {"train_ids": "a"}, "'train_ids' must be a list"),
        ("dataset.json", {"train_ids": ["../../etc/x"]}, "'train_ids' must be a list"),
        ("dataset.json", {"ids": [], "train_ids": [], "val_ids": []}, "nothing to read"),
        ("dataset.json", {"train_ids": ["000009"]}, "the key '000009' is missing"),
        ("metadata.json", {"000002": {"warp_id": -1}}, "'000002': warp_id must be a whole number"),
        ("metadata.json", {"000002": {"warp_id": 0.5}}, "'000002': warp_id must be a whole number"),
        (
            "metadata.json",
            {"000002": {"warp_id": float("nan")}},
            "'000002': warp_id must be a whole number",
        ),
        ("metadata.json", {"000002": 1}, "'000002': cannot be read"),
        ("scene.json", {"scale": 0}, "'scale' must be positive"),
        ("scene.json", {"center": [1, 2]}, "'center' must hold 3 finite numbers"),
        (
            "camera/000002.json",
            {"orientation": [[1, 0, 0]]},
            "'orientation' must hold 3x3 finite numbers",
        ),
        ("camera/000002.json", {"orientation": np.diag([1, 1, -1]).tolist()}, "mirrored"),
        (
            "camera/000002.json",
            {"position": [0, 0, float("nan")]},
            "'position' must hold 3 finite numbers",
        ),
        ("camera/000002.json", {"focal_length": -3}, "fl_x must be positive"),
        ("camera/000002.json", {"focal_length": None}, "'focal_length' must hold finite numbers"),
        ("camera/000002.json", {"image_size": [0, 0]}, "'image_size' must be positive"),
        ("camera/000002.json", {"image_size": [160, 12]}, "but its intrinsics are for 160x12"),
    ],
)
def test_bad_values(root: Path, file: str, change: dict[str, Any], line: str) -> None:
    edit_json(root / file, lambda content: content.update(change))
    with pytest.raises(DyngsError, match=line) as caught:
        read_nerfies(root)
    assert Path(file).name in str(caught.value) or "metadata.json" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[]", "\x00"])
@pytest.mark.parametrize(
    "file", ["dataset.json", "metadata.json", "scene.json", "camera/000002.json"]
)
def test_broken_files(root: Path, file: str, text: str) -> None:
    (root / file).write_text(text)
    with pytest.raises(DyngsError, match=file):
        read_nerfies(root)


def test_missing_files(root: Path) -> None:
    (root / "rgb/1x/000002.png").unlink()
    assert "1 of 6 images are missing" in read(root).warnings[0]
    (root / "camera" / "000002.json").unlink()
    with pytest.raises(DyngsError, match=r"000002\.json: cannot be read"):
        read_nerfies(root)
    for path in (root / "rgb/1x").iterdir():
        path.unlink()
    with pytest.raises(DyngsError, match="no images in 1x, 2x, 4x"):
        read_nerfies(root)


def test_without_scene_the_files_own_frame(root: Path) -> None:
    camera = json.loads((root / "camera" / "000000.json").read_text())
    (root / "scene.json").unlink()
    pose = read(root).splits["train"][0].cam_from_world
    assert np.linalg.inv(pose)[:3, 3] == pytest.approx(camera["position"])


def test_bad_points(root: Path) -> None:
    for points in (np.zeros((3, 4)), np.zeros(3), np.array([{}])):
        np.save(root / "points.npy", points, allow_pickle=True)
        with pytest.raises(DyngsError, match=r"points\.npy"):
            read_nerfies(root)
