"""Images and videos of runs and camera paths: which files appear, what they show, safe names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scene import Sliding, camera, moving_scene, write_moving_run
from two_balls import cameras_around, two_balls

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.images.video import read_frames
from dyngs.export.camera_paths import CameraPath, pick_cameras
from dyngs.export.images import (
    DrawnImage,
    OutputOptions,
    _straight_alpha,
    color_map,
    contact_sheet,
    depth_to_rgb,
    file_stems,
    render_frame,
    render_path,
    write_path_images,
    write_split_images,
)
from dyngs.export.video import require_video_suffix, video_writer
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.gaussians.static_scene import StaticScene
from dyngs.runs.opened import OpenedScene, open_run, wrap_scene

BALLS = StaticScene(gaussians=two_balls())
LABEL, GAP = 22, 6  # px, of contact sheets


def read_image(path: Path) -> np.ndarray:
    """(H, W, C) float32; 8-bit values in [0, 1]."""
    import OpenImageIO as oiio

    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT))


def write_balls(
    cameras: Cameras, out: Path | None, output: OutputOptions | None = None
) -> list[Path]:
    path = CameraPath(cameras)
    return write_path_images(wrap_scene(BALLS), path, out, output or OutputOptions())


def standing(*times: float) -> CameraPath:
    return CameraPath(pick_cameras(camera(), [0] * len(times)), times=times)


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> OpenedScene:
    return open_run(write_moving_run(tmp_path_factory.mktemp("moving"), standing=True))


def test_frames_are_the_renders_one_by_one() -> None:
    cameras = cameras_around(3)
    options = RenderOptions(depth="expected")
    background = torch.tensor([0.1, 0.2, 0.9])
    together = render(two_balls(), cameras, options, background=background)
    frames = list(render_path(replace(BALLS, background=background), CameraPath(cameras), options))
    assert len(frames) == 3
    assert together.depth is not None
    for i, frame in enumerate(frames):
        np.testing.assert_allclose(frame.rgb, together.rgb[i].clamp(0, 1), atol=1e-6)
        np.testing.assert_allclose(frame.alpha, together.alpha[i], atol=1e-6)
        np.testing.assert_allclose(frame.depth, together.depth[i], rtol=1e-5)
    assert next(render_path(BALLS, CameraPath(cameras))).depth is None


def test_each_frame_shows_the_scene_at_its_time_and_equal_times_deform_once() -> None:
    motion = Sliding()
    scene = moving_scene(motion)
    times = (0.0, 0.3, 0.3, 1.0)
    frames = list(render_path(scene, standing(*times)))
    assert motion.calls == 3
    for frame, time in zip(frames, times, strict=True):
        np.testing.assert_array_equal(frame.rgb, render_frame(scene, camera(), time).rgb)
    assert np.abs(frames[0].rgb - frames[3].rgb).max() > 0.1


def test_path_writes_numbered_images_depth_alpha_and_video(tmp_path: Path) -> None:
    cameras = cameras_around(4)
    output = OutputOptions(depth=True, alpha=True, video=tmp_path / "v" / "path.mp4", fps=12)
    written = write_balls(cameras, tmp_path / "out", output)
    assert len(written) == 4 * 4 + 1
    assert all(p.is_file() for p in written)
    frame = next(render_path(BALLS, CameraPath(cameras), RenderOptions(depth="expected")))
    image = read_image(tmp_path / "out" / "frame_0000.png")
    np.testing.assert_allclose(image, frame.rgb, atol=0.5 / 255 + 1e-6)
    depth = read_image(tmp_path / "out" / "frame_0000_depth.exr")
    np.testing.assert_array_equal(depth[..., 0], frame.depth)
    alpha = read_image(tmp_path / "out" / "frame_0000_alpha.png")
    np.testing.assert_allclose(alpha[..., 0], frame.alpha, atol=0.5 / 255 + 1e-6)
    assert read_image(tmp_path / "out" / "frame_0000_depth.png").shape == (18, 24, 3)
    video = list(read_frames(tmp_path / "v" / "path.mp4"))
    assert len(video) == 4
    assert video[0][9, 9, 0] > 150 > video[0][9, 9, 2]
    alone = OutputOptions(video=tmp_path / "alone" / "path.mp4", depth=True)
    assert write_balls(cameras, None, alone) == [tmp_path / "alone" / "path.mp4"]
    assert names(tmp_path / "alone") == ["path.mp4"]
    with pytest.raises(DyngsError, match="no output"):
        write_balls(cameras, None)
    with pytest.raises(DyngsError, match="no cameras"):
        write_balls(cameras_around(0), tmp_path)


def test_depth_colours_share_one_range_along_a_path(tmp_path: Path) -> None:
    """The same ball drawn from twice as far away must not have the same colour."""
    near = cameras_around(1, distance=3.0)
    far = cameras_around(1, distance=6.0)
    poses = torch.cat([near.cam_from_world, far.cam_from_world])
    cameras = Cameras(poses, near.intrinsics.repeat(2, 1, 1), 24, 18)
    write_balls(cameras, tmp_path, OutputOptions(depth=True))
    a, b = (read_image(tmp_path / f"frame_000{i}_depth.png") for i in range(2))
    assert a[9, 8, 0] > 3 * a[9, 8, 2]  # the near ball is red, the far one blue
    assert b[9, 10, 2] > b[9, 10, 0]


def test_split_of_a_run(run: OpenedScene, tmp_path: Path) -> None:
    output = OutputOptions(depth=True, alpha=True, video=tmp_path / "test.mp4")
    written = write_split_images(run, "test", tmp_path / "out", output)
    stems = ["r_000", "r_001", "r_002"]
    ends = (".png", "_alpha.png", "_depth.png", "_depth.exr")
    wanted = [f"{stem}{end}" for stem in stems for end in ends]
    assert names(tmp_path / "out") == sorted([*wanted, "sheet.png"])
    assert (written[-1].name, len(written)) == ("sheet.png", 14)
    a, b, c = (read_image(tmp_path / "out" / f"{stem}.png") for stem in stems)
    assert np.abs(a - b).max() > 10 / 255  # each at its own time
    assert np.abs(b - c).max() > 10 / 255
    height, width = a.shape[:2]
    sheet = read_image(written[-1])
    assert sheet.shape[:2] == (3 * (LABEL + height) + GAP, GAP + 3 * (width + GAP))
    assert len(list(read_frames(tmp_path / "test.mp4"))) == 3
    with pytest.raises(DyngsError, match="'val' has no views"):
        write_split_images(run, "val", tmp_path / "val")
    assert not (tmp_path / "val").exists()


@pytest.mark.parametrize(
    ("given_names", "stems"),
    [
        (["test/r_0", "test/r_1"], ["r_0", "r_1"]),
        (["left/0001", "right/0001"], ["left_0001", "right_0001"]),
        (["images/cam a/x.y"], ["x.y"]),
        (["a/b", "a_b", "A_B"], ["a_b", "a_b_2", "A_B_3"]),
        (["../../etc/passwd", "/etc/shadow"], ["passwd", "shadow"]),
        (["sheet", "r", "r_depth"], ["sheet_2", "r", "r_depth_2"]),
        (["..", "", "C:\\x"], ["view", "view_2", "C__x"]),
    ],
)
def test_file_stems_known_answers(given_names: list[str], stems: list[str]) -> None:
    assert file_stems(given_names) == stems


@settings(max_examples=25, deadline=None)
@given(st.lists(st.text(alphabet=st.sampled_from("aA./\\:_ \x00é*"), max_size=8), max_size=8))
def test_file_stems_are_safe_and_unique(given_names: list[str]) -> None:
    stems = file_stems(given_names)
    assert len(stems) == len(given_names) == len({stem.lower() for stem in stems})
    for stem in stems:
        assert stem not in ("", "sheet")
        assert not stem.startswith(".")
        assert not set(stem) & set("/\\:\x00*")


def test_sheet_holds_truth_render_and_error() -> None:
    truth = np.random.default_rng(0).uniform(size=(20, 30, 3)).astype(np.float32)
    grey = np.full((20, 30, 3), 100, np.uint8)
    sheet = contact_sheet([("one", truth, truth), ("two", grey, grey + np.uint8(25))])
    assert sheet.shape == (2 * (LABEL + 20) + GAP, GAP + 3 * (30 + GAP), 3)
    top = sheet[LABEL : LABEL + 20]
    panels = [top[:, GAP + i * (30 + GAP) : GAP + i * (30 + GAP) + 30] for i in range(3)]
    assert np.abs(panels[0] / 255.0 - truth).max() <= 0.5 / 255 + 1e-6
    assert np.array_equal(panels[0], panels[1])
    assert panels[2].max() <= 4, "no error is black (magma's darkest)"
    expected = color_map(np.full((1, 1), 5 * 25 / 255), "magma")[0, 0]
    assert np.array_equal(sheet[-GAP - 4, -GAP - 4], expected)


def test_near_is_red_far_is_blue_nothing_is_black() -> None:
    depth = np.array([[1.2, 1.8, 1.5, np.inf, np.nan]])
    alpha = np.array([[1.0, 1.0, 0.0, 0.0, 0.0]])
    rgb = depth_to_rgb(depth, alpha, limits=(1.0, 2.0)).astype(int)
    assert rgb[0, 0, 0] > rgb[0, 0, 2]
    assert rgb[0, 1, 2] > rgb[0, 1, 0]
    assert rgb[0, 2:].max() == 0
    ramp = np.linspace(2.0, 3.0, 1000)[None]
    seen = np.ones_like(ramp)
    strays = depth_to_rgb(np.append(ramp, [[1e9, np.nan]], 1), np.append(seen, [[1, 0]], 1))
    apart = strays[:, :1000].astype(int) - depth_to_rgb(ramp, seen)
    assert np.abs(apart).max() < 8, "the range is that of most pixels"


def image_of(height: int, width: int, shift: int = 0) -> np.ndarray:
    rgb = np.zeros((height, width, 3), np.uint8)
    rgb[: height // 2] = [200, 30, 60]
    rgb[height // 2 :] = [20, 220, 90]
    return np.roll(rgb, shift, axis=0)


@pytest.mark.parametrize(
    ("height", "width", "fps"), [(60, 16, 10.0), (91, 51, 23.976), (64, 33, 60.0)]
)
def test_images_survive_in_videos(tmp_path: Path, height: int, width: int, fps: float) -> None:
    images = [image_of(height, width, 3 * i) for i in range(4)]
    for name in ("a.mp4", "b.mp4"):
        with video_writer(tmp_path / name, fps=fps) as add:
            for rgb in images:
                add(rgb)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    frames = list(read_frames(tmp_path / "a.mp4"))
    assert len(frames) == 4
    for frame, rgb in zip(frames, images, strict=True):
        assert frame.shape == (height + height % 2, width + width % 2, 3)
        error = np.abs(frame[:height, :width].astype(int) - rgb)
        assert np.median(error) <= 4, "colours keep their matrix and range"
        assert error.mean() < 12  # edges bleed: colour has half the resolution
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert float(stream.average_rate or 0) == pytest.approx(fps, abs=0.01)


def write_video(path: Path, sizes: list[tuple[int, int]]) -> None:
    with video_writer(path) as add:
        for height, width in sizes:
            add(image_of(height, width))


@pytest.mark.parametrize(
    ("name", "sizes", "problem"),
    [
        ("v.mp4", [(32, 32), (32, 34)], "one|size"),
        ("v.mp4", [], "no images"),
        ("v.nope", [(16, 16)], r"v\.nope.*\.mp4"),
        ("file/v.mp4", [(16, 16)], "cannot write"),
    ],
)
def test_a_video_that_fails_leaves_the_former_file(
    tmp_path: Path, name: str, sizes: list[tuple[int, int]], problem: str
) -> None:
    for former in ("v.mp4", "v.nope", "file"):
        (tmp_path / former).write_bytes(b"old")
    with pytest.raises(DyngsError, match=problem):
        write_video(tmp_path / name, sizes)
    with pytest.raises(DyngsError, match="fps"), video_writer(tmp_path / "v.mp4", fps=0):
        pass
    assert {path.read_bytes() for path in tmp_path.iterdir()} == {b"old"}
    assert len(names(tmp_path)) == 3


@pytest.mark.parametrize("name", ["v.webm", "v.gif"])
def test_transparent_videos_keep_alpha_and_leave_no_trail(tmp_path: Path, name: str) -> None:
    with video_writer(tmp_path / name, fps=10) as add:
        for left in (4, 36):
            image = np.zeros((32, 64, 4), np.uint8)
            image[8:24, left : left + 20] = 200, 40, 40, 255
            add(image)
    with av.open(str(tmp_path / name)) as container:
        packets = container.demux(container.streams.video[0])
        # the default decoder of VP9 drops alpha
        decoder = av.CodecContext.create("gif" if name == "v.gif" else "libvpx-vp9", "r")
        frames = [frame for packet in packets for frame in decoder.decode(packet)]
    last = frames[-1].to_ndarray(format="rgba")
    assert len(frames) == 2
    assert last.shape == (32, 64, 4)
    assert np.abs(last[16, 46].astype(int) - (200, 40, 40, 255)).max() < 12
    assert last[16, 14, 3] < 8


def test_videos_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"written as .mp4.*use v.mp4"):
        require_video_suffix(tmp_path / "v.avi")
    with pytest.raises(DyngsError, match=r".mp4 has no transparency; use .webm"):
        require_video_suffix(tmp_path / "v.mp4", transparent=True)


def test_straight_alpha_of_an_image_on_black() -> None:
    frame = DrawnImage(np.full((1, 1, 3), 0.25, np.float32), np.full((1, 1), 0.5, np.float32), None)
    assert _straight_alpha(frame)[0, 0].tolist() == [0.5, 0.5, 0.5, 0.5]
