"""Images of runs and camera paths: which files appear, what they show, and safe names."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scene import Sliding, camera, moving_scene, still_scene, write_moving_run
from two_balls import cameras_around, two_balls

from dyngs.config import Config, DataConfig
from dyngs.config.io import RESOLVED_NAME, load_resolved, save_config
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.images.video import read_frames
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import StillOptions, write_still_capture
from dyngs.export.camera_paths.path import CameraPath, static_path
from dyngs.export.images import (
    OutputOptions,
    file_stems,
    path_frames,
    render_frame,
    write_path_images,
    write_split_images,
)
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.runs.checkpoint import Checkpoint, CheckpointInfo, save_checkpoint
from dyngs.runs.opened import open_run, opened_scene
from dyngs.static.scene import StaticScene


def read_image(path: Path) -> np.ndarray:
    """(H, W, C) float32; 8-bit values in [0, 1]."""
    import OpenImageIO as oiio

    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT))


BALLS = StaticScene(gaussians=two_balls())


def write_balls(
    cameras: Cameras, out: Path | None, output: OutputOptions | None = None
) -> list[Path]:
    return write_path_images(
        opened_scene(BALLS), CameraPath(cameras), out, output or OutputOptions()
    )


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def write_run(folder: Path, size: int = 24) -> Path:
    root = write_still_capture(
        folder / "capture", StillOptions(size=size, num_train=2, num_test=2, samples=1)
    )
    config = Config(data=DataConfig.model_validate({"root": root}))
    save_config(config, folder / "run" / RESOLVED_NAME)
    tensors = {f"gaussians.{name}": x.contiguous() for name, x in two_balls().tensors().items()}
    info = CheckpointInfo(1, 1.0, (0.0, 0.0, 0.0), "white", "classic")
    save_checkpoint(folder / "run", Checkpoint(info, tensors), 1.0)
    return folder / "run"


def test_frames_are_the_renders_one_by_one() -> None:
    gaussians = two_balls()
    cameras = cameras_around(3)
    options = RenderOptions(depth="expected")
    background = torch.tensor([0.1, 0.2, 0.9])
    together = render(gaussians, cameras, options, background=background)
    frames = list(path_frames(replace(BALLS, background=background), CameraPath(cameras), options))
    assert len(frames) == 3
    for i, frame in enumerate(frames):
        np.testing.assert_allclose(frame.rgb, together.rgb[i].clamp(0, 1), atol=1e-6)
        np.testing.assert_allclose(frame.alpha, together.alpha[i], atol=1e-6)
        assert frame.depth is not None
        assert together.depth is not None
        np.testing.assert_allclose(frame.depth, together.depth[i], rtol=1e-5)
    # a corner shows the background
    np.testing.assert_allclose(frames[0].rgb[0, 0], [0.1, 0.2, 0.9], atol=0.01)
    red = frames[0].rgb[9, 9]
    assert red[0] > 0.8
    assert red[1] < 0.2
    assert frames[0].depth is not None
    assert abs(frames[0].depth[9, 9] - 4) < 0.01
    assert next(path_frames(BALLS, CameraPath(cameras))).depth is None


def test_frames_are_drawn_lazily() -> None:
    frames = path_frames(BALLS, CameraPath(cameras_around(3)))
    next(frames)
    frames.close()  # type: ignore[attr-defined]


def test_each_frame_shows_the_scene_at_its_time() -> None:
    scene = moving_scene(Sliding())
    times = (0.0, 0.3, 1.0)
    frames = list(path_frames(scene, static_path(camera(), times)))
    for frame, time in zip(frames, times, strict=True):
        np.testing.assert_array_equal(frame.rgb, render_frame(scene, camera(), time).rgb)
    assert np.abs(frames[0].rgb - frames[2].rgb).max() > 0.1


def test_equal_times_deform_once() -> None:
    motion = Sliding()
    path = static_path(camera(), (0.5, 0.5, 0.5, 0.7, 0.7))
    assert len(list(path_frames(moving_scene(motion), path))) == 5
    assert motion.calls == 2


def test_what_never_moves_looks_the_same_at_all_times() -> None:
    frames = list(path_frames(still_scene(), static_path(camera(), (0.0, 0.5, 1.0))))
    assert all(np.array_equal(frame.rgb, frames[0].rgb) for frame in frames)


def test_path_writes_numbered_images(tmp_path) -> None:
    written = write_balls(cameras_around(3), tmp_path / "out")
    assert names(tmp_path / "out") == ["frame_0000.png", "frame_0001.png", "frame_0002.png"]
    assert [p.name for p in written] == names(tmp_path / "out")
    frame = next(path_frames(BALLS, CameraPath(cameras_around(3))))
    np.testing.assert_allclose(read_image(written[0]), frame.rgb, atol=0.5 / 255 + 1e-6)


def test_path_writes_depth_alpha_and_video(tmp_path) -> None:
    cameras = cameras_around(4)
    output = OutputOptions(depth=True, alpha=True, video=tmp_path / "v" / "path.mp4", fps=12)
    written = write_balls(cameras, tmp_path / "out", output)
    assert len(written) == 4 * 4 + 1
    assert all(p.is_file() for p in written)
    frame = next(path_frames(BALLS, CameraPath(cameras), RenderOptions(depth="expected")))
    depth = read_image(tmp_path / "out" / "frame_0000_depth.exr")
    assert depth.shape == (18, 24, 1)
    np.testing.assert_array_equal(depth[..., 0], frame.depth)
    alpha = read_image(tmp_path / "out" / "frame_0000_alpha.png")
    np.testing.assert_allclose(alpha[..., 0], frame.alpha, atol=0.5 / 255 + 1e-6)
    assert read_image(tmp_path / "out" / "frame_0000_depth.png").shape == (18, 24, 3)
    video = list(read_frames(tmp_path / "v" / "path.mp4"))
    assert len(video) == 4
    assert video[0].shape == (18, 24, 3)
    assert video[0][9, 9, 0] > 150 > video[0][9, 9, 2]


def test_path_to_a_video_alone(tmp_path) -> None:
    output = OutputOptions(video=tmp_path / "path.mp4", depth=True)
    assert write_balls(cameras_around(2), None, output) == [tmp_path / "path.mp4"]
    assert names(tmp_path) == ["path.mp4"]


def test_path_with_nothing_to_do(tmp_path) -> None:
    with pytest.raises(DyngsError, match="nothing to write"):
        write_balls(cameras_around(1), None)
    with pytest.raises(DyngsError, match="no cameras"):
        write_balls(cameras_around(0), tmp_path)


def test_depth_colours_share_one_range_along_a_path(tmp_path) -> None:
    """The same ball drawn from twice as far away must not have the same colour."""
    near = cameras_around(1, distance=3.0)
    far = cameras_around(1, distance=6.0)
    poses = torch.cat([near.cam_from_world, far.cam_from_world])
    cameras = Cameras(poses, near.intrinsics.repeat(2, 1, 1), 24, 18)
    write_balls(cameras, tmp_path, OutputOptions(depth=True))
    a, b = (read_image(tmp_path / f"frame_000{i}_depth.png") for i in range(2))
    assert a[9, 8, 0] > 3 * a[9, 8, 2]  # the near ball is red, the far one blue
    assert b[9, 10, 2] > b[9, 10, 0]


def test_depth_of_a_moving_path_shares_one_range(tmp_path) -> None:
    """Of 20 frames 8 are looked at beforehand, each at its own time."""
    opened = opened_scene(moving_scene(Sliding()))
    path = static_path(camera(), np.linspace(0, 1, 20).tolist())
    written = write_path_images(opened, path, tmp_path, OutputOptions(depth=True))
    assert len(written) == 60


def test_views_of_a_moving_run_are_drawn_at_their_own_times(tmp_path) -> None:
    run_dir = write_moving_run(tmp_path, standing=True)
    write_split_images(open_run(run_dir), "test", tmp_path / "out")
    a, b, c = (read_image(tmp_path / "out" / f"r_00{i}.png") for i in range(3))
    assert np.abs(a - b).max() > 10 / 255
    assert np.abs(b - c).max() > 10 / 255


def test_split_of_a_run(tmp_path) -> None:
    run_dir = write_run(tmp_path)
    written = write_split_images(
        open_run(run_dir), "test", tmp_path / "out", OutputOptions(depth=True, alpha=True)
    )
    stems = ["r_000", "r_001"]
    assert names(tmp_path / "out") == sorted(
        [f"{s}{end}" for s in stems for end in (".png", "_alpha.png", "_depth.png", "_depth.exr")]
        + ["sheet.png"]
    )
    assert written[-1].name == "sheet.png"
    assert len(written) == 9
    # white, as in training
    assert read_image(tmp_path / "out" / "r_000.png")[0, 0].tolist() == [1.0, 1.0, 1.0]
    sheet = read_image(written[-1])
    assert sheet.shape[1] >= 3 * 24
    assert sheet.shape[0] >= 2 * 24
    write_split_images(
        open_run(run_dir), "train", tmp_path / "train", OutputOptions(video=tmp_path / "train.mp4")
    )
    assert names(tmp_path / "train") == ["r_000.png", "r_001.png", "sheet.png"]
    assert len(list(read_frames(tmp_path / "train.mp4"))) == 2
    with pytest.raises(DyngsError, match="'val' has no views"):
        write_split_images(open_run(run_dir), "val", tmp_path / "val")
    assert not (tmp_path / "val").exists()


def test_images_of_the_capture_are_not_replaced(tmp_path) -> None:
    """Views and their images have the same names; so may frames of a path."""
    run_dir = write_run(tmp_path)
    views = read_capture(load_resolved(run_dir).data).splits["test"]
    folder = views[0].image_path.parent
    before = {path: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    (tmp_path / "link").symlink_to(folder)
    for out in (folder, tmp_path / "link"):
        with pytest.raises(DyngsError, match="exists and lies in"):
            write_split_images(open_run(run_dir), "test", out)
    (tmp_path / "links").mkdir()
    os.link(views[0].image_path, tmp_path / "links" / "frame_0000.png")
    opened = open_run(run_dir)
    path = CameraPath(cameras_around(1))
    with pytest.raises(DyngsError, match=r"holds frame_0000\.png, a link to"):
        write_path_images(opened, path, tmp_path / "links")
    assert {path: path.read_bytes() for path in folder.iterdir() if path.is_file()} == before


def test_file_stems_known_answers() -> None:
    assert file_stems(["test/r_0", "test/r_1"]) == ["r_0", "r_1"]
    assert file_stems(["left/0001", "right/0001"]) == ["left_0001", "right_0001"]
    assert file_stems(["images/cam a/x.y"]) == ["x.y"]
    assert file_stems(["a/b", "a_b", "A_B"]) == ["a_b", "a_b_2", "A_B_3"]
    assert file_stems(["../../etc/passwd", "/etc/shadow"]) == ["passwd", "shadow"]
    assert file_stems(["sheet", "r", "r_depth"]) == ["sheet_2", "r", "r_depth_2"]
    assert file_stems(["..", "", "C:\\x"]) == ["view", "view_2", "C__x"]
    # devices of Windows, whatever follows them, but not names that only begin so
    assert file_stems(["a/CON", "a/nul.left", "a/com1", "a/console"]) == [
        "CON_",
        "nul.left_",
        "com1_",
        "console",
    ]


@settings(max_examples=25, deadline=None)
@given(st.lists(st.text(alphabet=st.sampled_from("aA./\\:_ \x00é*"), max_size=8), max_size=8))
def test_file_stems_are_safe_and_unique(given_names) -> None:
    stems = file_stems(given_names)
    assert len(stems) == len(given_names) == len({stem.lower() for stem in stems})
    for stem in stems:
        assert stem
        assert not stem.startswith(".")
        assert not set(stem) & set("/\\:\x00*")
        assert stem != "sheet"
