"""Captures of any format: recognised, finished, with the priors that are there."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import get_args

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from tiny_captures import (
    edit_json,
    write_cameras_json,
    write_colmap,
    write_folder,
    write_frames,
    write_image,
    write_nerfies,
    write_poses_bounds,
    write_video,
)
from tiny_priors import with_priors

import dyngs
from dyngs.api.load import read_capture
from dyngs.capture.inspection.report import format_report, inspect_capture, report_on
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data import readers
from dyngs.data.capture import Capture, CaptureFormat
from dyngs.data.geometry import camera_center
from dyngs.data.loader import ImageLoader
from dyngs.data.read import FORMATS, require_images
from dyngs.data.synthetic.captures import StillOptions, write_still_capture

CAMERAS = ("cam00", "cam01", "cam02")


def read(root: Path, **options: object) -> Capture:
    return read_capture(DataConfig.model_validate({"root": root, **options}))


def names(capture: Capture, split: str) -> list[str]:
    return [view.name for view in capture.splits[split]]  # type: ignore[index]


def test_readers_configuration_and_docs_name_the_same_formats() -> None:
    """What a module in ``readers/`` declares as a format is in the list."""
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
    table = (Path(__file__).resolve().parents[2] / "docs" / "formats.md").read_text(
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


def test_a_folder_alone_is_read_with_default_options(blender_root: Path) -> None:
    expected = read(blender_root)
    for source in (blender_root, str(blender_root)):
        capture = dyngs.read_capture(source)
        assert {split: names(capture, split) for split in capture.splits} == {
            split: names(expected, split) for split in expected.splits
        }


def test_nerfstudio_is_recognised(nerfstudio_root: Path) -> None:
    capture = read(nerfstudio_root)
    assert (capture.format, capture.has_alpha) == ("nerfstudio", False)
    assert names(capture, "test") == ["images/00", "images/08"]


def test_colmap_is_recognised(colmap_root: Path) -> None:
    capture = read(colmap_root)
    assert capture.format == "colmap"
    assert names(capture, "test") == ["left/01", "right/08"]


def test_two_formats_in_one_folder(nerfstudio_root: Path) -> None:
    """Recognition says which it took; naming the format takes the other."""
    for path in (nerfstudio_root / "images").iterdir():
        path.rename(path.with_name("x" + path.name))
    edit_json(
        nerfstudio_root / "transforms.json",
        lambda c: [f.update(file_path=f["file_path"].replace("/", "/x")) for f in c["frames"]],
    )
    write_colmap(nerfstudio_root)
    both = read(nerfstudio_root)
    assert both.format == "nerfstudio"
    assert "also a colmap capture" in both.warnings[0]
    assert read(nerfstudio_root, format="colmap").format == "colmap"


@pytest.mark.parametrize(("every", "test"), [(8, [0, 8]), (3, [0, 3, 6, 9, 12, 15]), (0, [])])
def test_every_nth_by_name_is_held_out(blender_root: Path, every: int, test: list[int]) -> None:
    (blender_root / "transforms_test.json").unlink()
    capture = read(blender_root, test_every=every)
    everything = sorted(f"train/r_{i}" for i in range(16))
    assert names(capture, "test") == [everything[i] for i in test]
    assert names(capture, "train") == [name for i, name in enumerate(everything) if i not in test]


def test_holding_out_all_is_an_error(nerfstudio_root: Path) -> None:
    with pytest.raises(DyngsError, match="test_every=1 leaves no training views"):
        read(nerfstudio_root, test_every=1)


def test_no_such_folder(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="nowhere: no such folder"):
        read(tmp_path / "nowhere")
    (tmp_path / "file.json").write_text("{}")
    with pytest.raises(DyngsError, match=r"file\.json: is a file"):
        read(tmp_path / "file.json")


def test_nothing_recognised_lists_what_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(DyngsError) as caught:
        read(tmp_path)
    files = ("transforms_train.json", "transforms.json", "cameras.bin", "colmap/sparse/0")
    for wanted in (*files, "dataset.json", "poses_bounds.npy", "cameras.json"):
        assert wanted in str(caught.value)


def test_named_format_is_absent(blender_root: Path) -> None:
    with pytest.raises(DyngsError, match=r"no colmap capture.*but there is a blender capture"):
        read(blender_root, format="colmap")


@pytest.mark.parametrize("frames", [[], None])
def test_zero_views(nerfstudio_root: Path, frames: list | None) -> None:
    edit_json(nerfstudio_root / "transforms.json", lambda c: c.update(frames=frames))
    with pytest.raises(DyngsError, match=r"no training views|'frames' is missing"):
        read(nerfstudio_root)


def test_empty_test_file_is_a_warning(blender_root: Path) -> None:
    edit_json(blender_root / "transforms_test.json", lambda c: c.update(frames=[]))
    capture = read(blender_root)
    assert names(capture, "test") == []
    assert len(names(capture, "train")) == 16
    assert "lists no frames" in capture.warnings[0]


def test_missing_images_are_a_warning_and_then_an_error_of_the_loader(colmap_root: Path) -> None:
    (colmap_root / "images/left/03.jpg").unlink()
    capture = read(colmap_root)
    assert "1 of 9 images are missing" in capture.warnings[0]
    with pytest.raises(DyngsError, match=r"left/03\.jpg"):
        ImageLoader(capture.splits["train"], DataConfig.model_validate({"root": colmap_root}))


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
        "2 of 9 images are missing" in line and line.endswith("left out")
        for line in capture.warnings
    )
    ImageLoader(capture.splits["train"], DataConfig.model_validate({"root": colmap_root}))


def test_without_any_image_there_is_nothing_to_train_on(nerfstudio_root: Path) -> None:
    for path in (nerfstudio_root / "images").iterdir():
        path.unlink()
    edit_json(nerfstudio_root / "transforms.json", lambda c: c.update(w=12, h=8))
    with pytest.raises(DyngsError, match="has no training views"):
        read(nerfstudio_root, skip_missing=True)


def test_the_layer_that_is_read_of_exr_images_is_named(tmp_path: Path) -> None:
    for i in range(4):
        spec = oiio.ImageSpec(8, 6, 7, "half")
        spec.channelnames = [
            *(f"N.{c}" for c in "RGB"),
            *(f"ViewLayer.Combined.{c}" for c in "RGBA"),
        ]
        output = oiio.ImageOutput.create(str(tmp_path / f"{i}.exr"))
        assert output.open(str(tmp_path / f"{i}.exr"), spec)
        assert output.write_image(np.full((6, 8, 7), 0.2 * i, np.float32))
        output.close()
    fields = {"fl_x": 8.0, "w": 8, "h": 6}
    write_frames(tmp_path / "transforms.json", [f"{i}.exr" for i in range(4)], fields)
    capture = read(tmp_path)
    assert "the layer ViewLayer.Combined of EXR images is read" in capture.warnings
    assert capture.has_alpha


def test_two_images_of_one_name(nerfstudio_root: Path) -> None:
    edit_json(
        nerfstudio_root / "transforms.json",
        lambda c: c["frames"][1].update(file_path="images/00.png"),
    )
    with pytest.raises(DyngsError, match=r"00\.(png|jpg) share the name images/00"):
        read(nerfstudio_root)


def test_training_on_the_test_set_is_a_warning(blender_root: Path) -> None:
    edit_json(
        blender_root / "transforms_test.json",
        lambda c: c["frames"][0].update(file_path="train/r_1"),
    )
    assert read(blender_root).warnings == (
        "1 test images are also training images, first train/r_1",
    )


def set_times(root: Path, split: str, times: list[float]) -> None:
    def change(content: dict) -> None:
        for frame, time in zip(content["frames"], times, strict=False):
            frame["time"] = time

    edit_json(root / f"transforms_{split}.json", change)


def test_times_in_frames_are_scaled_to_one(blender_root: Path) -> None:
    set_times(blender_root, "train", [float(i) for i in range(16)])
    set_times(blender_root, "test", [7.5, 20.0])
    capture = read(blender_root)
    times = {view.name: view.time for views in capture.splits.values() for view in views}
    assert (times["train/r_0"], times["train/r_15"], times["test/r_0"], times["test/r_1"]) == (
        0,
        0.75,
        0.375,
        1,
    )
    assert "times run from 0 to 20" in capture.warnings[0]


def test_times_are_stretched_to_the_span_of_all_splits(blender_root: Path) -> None:
    """As in D-NeRF-like folders whose times run from 0 to 0.055."""
    set_times(blender_root, "train", [0.003 * i for i in range(16)])
    set_times(blender_root, "test", [0.015, 0.06])
    edit_json(blender_root / "transforms_train.json", lambda c: c.update(fps=30))
    capture = read(blender_root)
    assert [view.time for view in capture.splits["test"]] == pytest.approx([0.25, 1.0])
    assert sorted(view.time or 0.0 for view in capture.splits["train"]) == pytest.approx(
        [0.05 * i for i in range(16)]
    )
    assert capture.warnings == ("times run from 0 to 0.06 and were scaled to [0, 1]",)
    assert (capture.span, capture.seconds) == ((0.0, 0.06), None)
    assert dict(report_on(capture).facts)["times"] == "17 in 0 to 1 (0 to 0.06 in the files)"


def test_times_from_0_to_1_are_kept_exactly(blender_root: Path) -> None:
    set_times(blender_root, "train", [i / 15 for i in range(16)])
    set_times(blender_root, "test", [0.1, 0.3])
    edit_json(blender_root / "transforms_train.json", lambda c: c.update(fps=30))
    edit_json(blender_root / "transforms_test.json", lambda c: c["frames"].clear())
    capture = read(blender_root)
    assert {view.time for view in capture.splits["train"]} == {i / 15 for i in range(16)}
    assert (capture.span, capture.seconds) == ((0.0, 1.0), pytest.approx(0.5))
    facts = dict(report_on(capture).facts)
    assert (facts["times"], facts["duration"]) == (
        "16 in 0 to 1",
        "0.5 seconds from time 0 to time 1",
    )


def test_time_for_some_is_an_error(blender_root: Path) -> None:
    set_times(blender_root, "train", [0.5])
    with pytest.raises(DyngsError, match="has no time"):
        read(blender_root)


@pytest.mark.parametrize("time", [float("nan"), float("inf"), "0.5", [1], True])
def test_a_time_that_is_no_number_names_its_frame(blender_root: Path, time: object) -> None:
    set_times(blender_root, "train", [0.5] * 16)
    edit_json(blender_root / "transforms_train.json", lambda c: c["frames"][3].update(time=time))
    with pytest.raises(
        DyngsError, match=r"frame 3 \(\./train/r_3\): 'time' must be a finite number"
    ):
        read(blender_root)


def test_one_time_for_all_is_a_still_scene(blender_root: Path) -> None:
    set_times(blender_root, "train", [0.5] * 16)
    set_times(blender_root, "test", [0.5] * 2)
    capture = read(blender_root)
    assert {view.time for view in capture.splits["train"]} == {None}
    assert capture.warnings == ("all images have time 0.5: treated as a static scene",)


def test_seconds_of_numbered_images(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    ordered = DataConfig(root=tmp_path, times="order", frames_per_second=10)
    capture = read_capture(ordered)
    assert capture.in_seconds
    assert capture.span is not None
    assert capture.seconds == pytest.approx(capture.span[1] - capture.span[0])
    plain = read_capture(ordered.model_copy(update={"frames_per_second": None}))
    assert plain.span is not None
    assert capture.span == pytest.approx(np.array(plain.span) / 10)
    with pytest.raises(DyngsError, match=r"frames_per_second=10 needs data\.times=order"):
        read_capture(ordered.model_copy(update={"times": "files"}))


def test_order_of_times_does_not_matter(blender_root: Path) -> None:
    set_times(blender_root, "train", [(7 * i % 16) / 15 for i in range(16)])
    set_times(blender_root, "test", [1.0, 0.0])
    capture = read(blender_root)
    assert {view.name: view.time for view in capture.splits["test"]} == {
        "test/r_0": 1.0,
        "test/r_1": 0.0,
    }
    assert capture.warnings == ()


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
    assert names(capture, "test") == ["train/r_0", "train/r_2"]
    assert len(names(capture, "train")) == 6


@pytest.mark.parametrize(
    ("frames", "line"), [("1-2", "start:stop:step"), ("5:5", "picks none of"), ("0:9:0", "step")]
)
def test_bad_choices_of_frames(blender_root: Path, frames: str, line: str) -> None:
    set_times(blender_root, "train", [i / 15 for i in range(16)])
    set_times(blender_root, "test", [0.5, 0.5])
    with pytest.raises(DyngsError, match=rf"data\.frames.*{line}"):
        read(blender_root, frames=frames)


def test_frames_of_a_still_scene(blender_root: Path) -> None:
    with pytest.raises(DyngsError, match=r"data\.frames=0:5 picks times, but the capture has none"):
        read(blender_root, frames="0:5")


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
    with pytest.raises(DyngsError, match=f"no colmap capture.*but there is a {form} capture"):
        read(tmp_path, format="colmap")


@pytest.mark.parametrize("form", ["nerfies", "llff", "camera_folders"])
def test_a_folder_given_relative_to_where_we_are(
    tmp_path: Path, form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "deep" / "capture"
    root.mkdir(parents=True)
    if form == "nerfies":
        write_nerfies(root)
    elif form == "llff":
        write_poses_bounds(root, len(CAMERAS))
    else:
        write_cameras_json(root, CAMERAS)
    for name in CAMERAS if form != "nerfies" else ():
        write_video(root / f"{name}.mp4", 2)
    monkeypatch.chdir(tmp_path)
    for written in ("deep/capture", "deep/../deep/capture"):
        capture = read(Path(written))
        assert all(view.image_path.is_file() for views in capture.splits.values() for view in views)
        assert not any("missing" in warning for warning in capture.warnings)


def test_far_world_is_rebased(nerfstudio_root: Path) -> None:
    """Georeferenced capture: the offset is kept, the cameras come to the origin."""

    def change(content: dict) -> None:
        for frame in content["frames"]:
            frame["transform_matrix"][0][3] += 4.5e6

    edit_json(nerfstudio_root / "transforms.json", change)
    capture = read(nerfstudio_root)
    assert capture.world_offset[0] == pytest.approx(4.5e6, abs=10)
    centers = np.array([camera_center(view.cam_from_world) for view in capture.splits["train"]])
    assert np.abs(centers).max() < 10


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


def test_part_of_a_real_sequence(shared: Path) -> None:
    capture = read(shared / "stage", frames="6:12")
    assert (len(capture.splits["train"]), len(capture.splits["test"]), capture.warnings) == (
        48,
        6,
        (),
    )
    assert sorted({view.time for view in capture.splits["test"]}) == pytest.approx(
        [i / 5 for i in range(6)], abs=1e-4
    )


def test_new_poses_keep_times_and_frames_of_their_own(shared: Path) -> None:
    """They are another clip: choosing frames of the first one leaves them alone."""
    if not (shared / "human" / "casual_m").is_dir():
        pytest.skip("the captures of people are not here")
    capture = read_capture(
        DataConfig.model_validate({"root": shared / "human" / "casual_m", "frames": "0:5"})
    )
    assert (capture.format, capture.warnings, capture.has_alpha) == ("body_json", (), True)
    assert {name: len(views) for name, views in capture.splits.items()} == {
        "train": 40,
        "test": 20,
        "val": 0,
        "pose": 32,
    }
    assert {view.time for view in capture.splits["train"]} == {0.0, 0.25, 0.5, 0.75, 1.0}
    assert sorted({view.time for view in capture.splits["pose"]}) == pytest.approx(
        [i / 7 for i in range(8)]
    )
    assert capture.body is not None
    assert {name: len(body.frames) for name, body in capture.body.items()} == {
        "train": 20,
        "val": 20,
        "test": 20,
        "pose": 8,
    }


def test_a_fisheye_is_undistorted_to_the_pinhole_that_is_asked_for(tmp_path: Path) -> None:
    """A wide one shows more of what the lens saw, and leaves out of the loss what it did not
    see."""
    root = write_still_capture(
        tmp_path / "still", StillOptions(size=16, num_train=3, num_test=1, samples=1)
    )
    for split in ("train", "test"):
        edit_json(
            root / f"transforms_{split}.json",
            lambda content: content.update(is_fisheye=True, camera_angle_x=1.5),
        )
    same, wide = (read(root, undistort=how) for how in ("same_focal", "wide"))
    for view, before in zip(wide.splits["train"], same.splits["train"], strict=True):
        assert before.lens.focal_ratio == 1
        assert view.lens.focal_ratio > 1.1
        np.testing.assert_allclose(
            view.intrinsics[0, 0] * view.lens.focal_ratio, before.intrinsics[0, 0]
        )
    said = [dict(report_on(capture).facts)["lens"] for capture in (same, wide)]
    assert "data.undistort=wide keeps more" in said[0]
    assert "of the focal length, which keeps 9" in said[1]
    masks = [
        ImageLoader(capture.splits["train"], DataConfig(root=root))[0].mask
        for capture in (same, wide)
    ]
    assert masks[0] is None
    assert masks[1] is not None
    assert 0.5 < float(masks[1].mean()) < 1


def loaded(root: Path, **options: object) -> ImageLoader:
    config = DataConfig.model_validate({"root": root, "test_every": 0, **options})
    return ImageLoader(read_capture(config).splits["train"], config, with_maps=True)


def test_maps_come_with_the_image(tmp_path: Path) -> None:
    """Flow in the pixels of the smaller image; depth of its own size; the next view is that of the
    next time."""
    images = loaded(with_priors(tmp_path), downscale=2)
    assert [view.flow_to for view in images.views] == [None, "a", "b"]
    first = images[0]
    second = images[1]
    assert first.moves is not None
    assert first.depth is not None
    assert second.moves is not None
    assert second.flow is not None
    assert first.moves.shape == first.depth.shape == (4, 6)
    assert (float(first.moves.max()), float(second.moves.min()), float(first.depth.max())) == (
        0,
        1,
        2,
    )
    torch.testing.assert_close(second.flow, torch.full((4, 6, 2), 2.0))
    small = second.shrunk(2)
    assert small.flow is not None
    assert small.depth is not None
    assert float(small.flow.max()) == 1
    assert float(small.depth.min()) == 3


def test_who_does_not_ask_for_maps_does_not_pay_for_them(tmp_path: Path) -> None:
    views = read_capture(with_priors(tmp_path)).splits["train"]
    (tmp_path / "a_depth.npy").write_bytes(b"")
    image = ImageLoader(views)[0]
    assert image.depth is None
    assert image.flow is None


def test_missing_priors_are_done_without(tmp_path: Path) -> None:
    with_priors(tmp_path)
    for name in ("b_depth.npy", "c_moves.png", "tracks.npz"):
        (tmp_path / name).unlink()
    capture = read_capture(DataConfig(root=tmp_path, test_every=0))
    assert [view.depth_path is None for view in capture.splits["train"]] == [False, True, False]
    assert capture.tracks_path is None
    assert any("1 of 3 depth maps are missing" in line for line in capture.warnings)
    assert any("1 of 3 motion masks are missing" in line for line in capture.warnings)
    assert any("tracks.npz are missing" in line for line in capture.warnings)


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


def test_maps_of_another_size_are_refused(tmp_path: Path) -> None:
    np.save(with_priors(tmp_path) / "b_flow.npy", np.zeros((4, 6, 2)))
    with pytest.raises(
        DyngsError, match=r"b_flow\.npy: the flow field is 6x4 but its image is 12x8"
    ):
        loaded(tmp_path)[1]


def test_instance_masks_mean_that_everything_labelled_moves(tmp_path: Path) -> None:
    with_priors(tmp_path)
    write_image(tmp_path / "labels.png", np.arange(96, dtype=np.uint16).reshape(8, 12, 1))
    edit_json(
        tmp_path / "transforms_train.json",
        lambda c: (
            c["frames"][0].pop("motion_mask_path")
            and c["frames"][0].update(instance_mask_path="labels.png")
        ),
    )
    moves = loaded(tmp_path)[0].moves
    assert moves is not None
    assert int(moves.sum()) == 95


def test_inspection_counts_them(tmp_path: Path) -> None:
    report = format_report(inspect_capture(DataConfig(root=with_priors(tmp_path), test_every=0)))
    assert "3 depth maps, 3 motion masks, 3 flow fields, 1 file of tracks" in report
