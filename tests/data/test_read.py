"""Captures of any format: detection, normalisation, and priors such as depth and flow."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from tiny_captures import (
    edit_json,
    write_cameras_json,
    write_colmap,
    write_folder,
    write_nerfies,
    write_poses_bounds,
)
from tiny_priors import with_priors

from dyngs.api.load import read_capture
from dyngs.capture.inspection import build_report
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data import readers
from dyngs.data.capture import Capture, CaptureFormat
from dyngs.data.loader import ImageLoader
from dyngs.data.read import FORMATS, require_images

CAMERAS = ("cam00", "cam01", "cam02")


def read(root: Path, **options: object) -> Capture:
    return read_capture(DataConfig.model_validate({"root": root, **options}))


def names(capture: Capture, split: str) -> list[str]:
    return [view.name for view in capture.splits[split]]  # type: ignore[index]


def test_readers_configuration_and_docs_name_the_same_formats() -> None:
    """Every ``CaptureFormat`` in ``readers/`` is listed in ``FORMATS``, the configuration and the
    docs."""
    modules = [
        import_module(f"{readers.__name__}.{path.stem}")
        for path in Path(readers.__file__).parent.glob("*.py")
    ]
    declared = [
        x for module in modules for x in vars(module).values() if isinstance(x, CaptureFormat)
    ]
    names = {format.name for format in FORMATS}
    assert (len(names), {format.name for format in declared}) == (len(FORMATS), names)
    assert set(get_args(DataConfig.model_fields["format"].annotation)) == {"auto", *names}
    table = (Path(__file__).resolve().parents[2] / "docs" / "reference" / "captures.md").read_text(
        encoding="utf-8"
    )
    assert [name for name in names if f"\n| `{name}` |" not in table] == []
    assert {format.extends for format in FORMATS} - {None} <= names


def test_formats_are_recognised(blender_root: Path) -> None:
    capture = read(blender_root)
    assert (capture.format, capture.has_alpha) == ("blender", True)
    assert {name: len(views) for name, views in capture.splits.items()} == {
        "train": 16,
        "val": 0,
        "test": 2,
    }
    assert capture.world_offset.tolist() == [0, 0, 0]
    assert capture.warnings == ()


def test_two_formats_in_one_folder(nerfstudio_root: Path) -> None:
    """A warning names the other format, and ``data.format`` selects it."""
    for path in (nerfstudio_root / "images").iterdir():
        path.rename(path.with_name("x" + path.name))
    edit_json(
        nerfstudio_root / "transforms.json",
        lambda c: [f.update(file_path=f["file_path"].replace("/", "/x")) for f in c["frames"]],
    )
    write_colmap(nerfstudio_root)
    both = read(nerfstudio_root)
    assert both.format == "nerfstudio"
    assert "a colmap capture is also there" in both.warnings[0]
    assert read(nerfstudio_root, format="colmap").format == "colmap"


def test_nothing_recognised_lists_what_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(DyngsError) as caught:
        read(tmp_path)
    files = ("transforms_train.json", "transforms.json", "cameras.bin", "colmap/sparse/0")
    for wanted in (*files, "dataset.json", "poses_bounds.npy", "cameras.json"):
        assert wanted in str(caught.value)


def test_views_without_images_may_be_left_out(colmap_root: Path) -> None:
    """Before every n-th of the others is held out; the count is of all splits."""
    for name in ("left/01.jpg", "left/03.jpg"):
        (colmap_root / "images" / name).unlink()
    with pytest.raises(
        DyngsError, match=r"2 of 9 images are missing, first .*left/03\.jpg; .*skip_missing=true"
    ):
        require_images(read(colmap_root))
    capture = require_images(read(colmap_root, skip_missing=True))
    assert (names(capture, "test"), len(capture.splits["train"])) == (["left/05"], 6)
    assert any(
        "2 of 9 images are missing" in line and line.endswith("skipped")
        for line in capture.warnings
    )
    ImageLoader(capture.splits["train"], DataConfig.model_validate({"root": colmap_root}))


def set_times(root: Path, split: str, times: list[float]) -> None:
    def change(content: dict) -> None:
        for frame, time in zip(content["frames"], times, strict=False):
            frame["time"] = time

    edit_json(root / f"transforms_{split}.json", change)


def test_times_are_stretched_to_the_span_of_all_splits(blender_root: Path) -> None:
    """Times of D-NeRF-like folders, which run from 0 to about 0.055, are scaled to [0, 1]."""
    set_times(blender_root, "train", [0.003 * i for i in range(16)])
    set_times(blender_root, "test", [0.015, 0.06])
    edit_json(blender_root / "transforms_train.json", lambda c: c.update(fps=30))
    capture = read(blender_root)
    assert [view.time for view in capture.splits["test"]] == pytest.approx([0.25, 1.0])
    assert sorted(view.time or 0.0 for view in capture.splits["train"]) == pytest.approx(
        [0.05 * i for i in range(16)]
    )
    assert capture.warnings == ("times 0 to 0.06 scaled to [0, 1]",)
    assert (capture.file_time_span, capture.seconds) == ((0.0, 0.06), None)
    assert dict(build_report(capture).facts)["times"] == "17 in 0 to 1 (0 to 0.06 in the files)"


def test_frames_of_any_format_with_times(blender_root: Path) -> None:
    """Chosen over the times of all splits, before anything is held out."""
    set_times(blender_root, "train", [float(i) for i in range(16)])
    set_times(blender_root, "test", [2.5, 12.0])
    capture = read(blender_root, frames="2:6")  # 2, 2.5, 3, 4
    assert {view.name: view.time for views in capture.splits.values() for view in views} == {
        "train/r_2": 0.0,
        "test/r_0": pytest.approx(0.25),
        "train/r_3": pytest.approx(0.5),
        "train/r_4": 1.0,
    }
    (blender_root / "transforms_test.json").unlink()
    capture = read(blender_root, frames="::2", test_every=4)
    assert names(capture, "test") == ["train/r_12", "train/r_4"]
    assert len(names(capture, "train")) == 6


def test_the_ends_of_a_clip_are_trained_on(blender_root: Path) -> None:
    """Frames are counted in order of time. Images without times are counted from the first."""
    (blender_root / "transforms_test.json").unlink()
    assert held_out_frames(read(blender_root, test_every=4)) == [0, 12, 2, 6]
    set_times(blender_root, "train", [float(15 - i) for i in range(16)])
    capture = read(blender_root, test_every=4)
    assert held_out_frames(capture) == [1, 13, 5, 9]
    assert {0.0, 1.0} < {view.time for view in capture.splits["train"]}
    assert held_out_frames(read(blender_root, test_every=4, test_first=3)) == [11, 15, 5, 9]
    assert held_out_frames(read(blender_root, test_every=15)) == [8]


def held_out_frames(capture: Capture) -> list[int]:
    return [int(name.removeprefix("train/r_")) for name in names(capture, "test")]


@pytest.mark.parametrize("form", ["nerfies", "llff", "camera_folders"])
def test_dynamic_formats_are_recognised_and_load(tmp_path: Path, form: str) -> None:
    if form == "nerfies":
        write_nerfies(tmp_path)
    else:
        if form == "llff":
            write_poses_bounds(tmp_path, len(CAMERAS))
        else:
            write_cameras_json(tmp_path, CAMERAS)
        for name in CAMERAS:
            write_folder(tmp_path / name, range(2))
    for options in ({}, {"format": form}):
        capture = read(tmp_path, **options)
        assert capture.format == form
        loader = ImageLoader(capture.splits["train"], DataConfig(root=tmp_path, downscale=2))
        assert loader[0].rgb_premultiplied.shape == (6, 8, 3)
        assert loader[0].time == capture.splits["train"][0].time
    with pytest.raises(DyngsError, match=f"no colmap capture.*it contains a {form} capture"):
        read(tmp_path, format="colmap")


@pytest.mark.parametrize(
    ("name", "form", "counts", "alpha", "times"),
    [
        ("lego400", "blender", (100, 0, 50), True, 0),
        ("fox", "nerfstudio", (43, 0, 7), False, 0),
        ("colmap_small", "colmap", (67, 0, 10), False, 0),
        ("orbits", "blender", (100, 10, 20), True, 100),
        ("flag", "blender", (100, 10, 20), True, 100),
        ("stage", "blender", (192, 0, 24), False, 24),
    ],
)
def test_real_captures(
    shared: Path, name: str, form: str, counts: tuple, alpha: bool, times: int
) -> None:
    capture = read(shared / name)
    found = tuple(len(capture.splits[split]) for split in ("train", "val", "test"))
    assert (capture.format, found, capture.has_alpha, capture.warnings) == (form, counts, alpha, ())
    assert len({view.time for view in capture.splits["train"] if view.time is not None}) == times
    for views in capture.splits.values():
        assert [view.name for view in views] == sorted(view.name for view in views)
        ImageLoader(views, DataConfig.model_validate({"root": shared / name}))


def loaded(root: Path, **options: object) -> ImageLoader:
    config = DataConfig.model_validate({"root": root, "test_every": 0, **options})
    return ImageLoader(read_capture(config).splits["train"], config, with_maps=True)


def test_maps_come_with_the_image(tmp_path: Path) -> None:
    """Flow is in pixels of the downscaled image, depth keeps its size, and flow leads to the next
    time step."""
    images = loaded(with_priors(tmp_path), downscale=2)
    assert [view.flow_to for view in images.views] == [None, "a", "b"]
    first = images[0]
    second = images[1]
    assert first.motion_mask is not None
    assert first.depth is not None
    assert second.motion_mask is not None
    assert second.flow is not None
    assert first.motion_mask.shape == first.depth.shape == (4, 6)
    assert (
        float(first.motion_mask.max()),
        float(second.motion_mask.min()),
        float(first.depth.max()),
    ) == (
        0,
        1,
        2,
    )
    torch.testing.assert_close(second.flow, torch.full((4, 6, 2), 2.0))
    small = second.downscaled(2)
    assert small.flow is not None
    assert small.depth is not None
    assert float(small.flow.max()) == 1
    assert float(small.depth.min()) == 3


@pytest.mark.parametrize(
    "key", ["depth_file_path", "flow_file_path", "motion_mask_path", "instance_mask_path"]
)
def test_priors_outside_the_capture_are_refused(tmp_path: Path, key: str) -> None:
    root = tmp_path / "capture"
    root.mkdir()
    with_priors(root)
    np.save(tmp_path / "other.npy", np.zeros(3))
    edit_json(
        root / "transforms_train.json",
        lambda c: (
            [f.pop("motion_mask_path") for f in c["frames"]]
            and c["frames"][1].update({key: "../other.npy"})
        ),
    )
    with pytest.raises(DyngsError, match="outside the capture"):
        read_capture(root)
