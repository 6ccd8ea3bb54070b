"""Captures of several videos: what is given, offsets by sound, time steps, and poses against the
cameras that the videos were made with."""

from __future__ import annotations

import json
from pathlib import Path

import av
import numpy as np
import pytest
from stage_videos import camera, corner, write_videos

from dyngs.api.load import read_capture
from dyngs.capture.sfm.colmap import SfmOptions
from dyngs.capture.sfm.several_videos import (
    VIDEOS_FILE,
    CameraVideo,
    estimate_shift,
    estimate_starts_by_sound,
    frames_at_steps,
    open_video,
    poses_of_videos,
    read_video_settings,
)
from dyngs.core.errors import DyngsError
from dyngs.data.capture import all_views
from dyngs.data.images.video import VideoInfo
from dyngs.data.times import static_cameras
from dyngs.export.video import video_writer

AZIMUTHS = {"left": 32.0, "middle": 41.0, "phone": 49.0, "right": 58.0}
STARTS = {"left": 0.03, "middle": 0.0, "phone": 0.37, "right": 0.16}
"""Seconds, between frames of 0.1 s."""


@pytest.fixture(scope="module")
def capture_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("several")
    write_videos(folder / "rig", AZIMUTHS, STARTS, 10.0, 24)
    (folder / "rig" / "videos.json").write_text(json.dumps({"starts": STARTS}))
    said = poses_of_videos(folder / "rig", folder / "out", SfmOptions(num_threads=1))
    assert "4 of 4 cameras registered" in said
    assert "as given" in said
    return folder / "out"


def test_silent_videos_without_offsets_are_refused(tmp_path: Path) -> None:
    write_videos(tmp_path / "rig", {"a": 40.0, "b": 50.0}, {"a": 0.0, "b": 0.2}, 10.0, 6)
    with pytest.raises(
        DyngsError,
        match=r'a has no sound; give the start .* in videos\.json next to them, {"starts"',
    ):
        poses_of_videos(tmp_path / "rig", tmp_path / "out", SfmOptions(num_threads=1))
    assert not (tmp_path / "out").exists()


def test_cameras_stand_where_they_did(capture_root: Path) -> None:
    capture = read_capture(capture_root)
    poses = {view.name.split("/")[0]: view.cam_from_world for view in all_views(capture.splits)}
    names = list(AZIMUTHS)
    for name in names[1:]:
        expected = camera(AZIMUTHS[name], 0.9 + 0.15 * (names.index(name) % 2)) @ np.linalg.inv(
            camera(32.0, 0.9)
        )
        turned = poses[name] @ np.linalg.inv(poses["left"])
        cosine = (np.trace(expected[:3, :3] @ turned[:3, :3].T) - 1) / 2
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < 1.5, name


def test_the_capture_has_seconds_in_one_clock_and_a_camera_for_testing(capture_root: Path) -> None:
    capture = read_capture(capture_root)
    views = all_views(capture.splits)
    assert {view.name.split("/")[0] for view in capture.splits["test"]} == {"left"}
    assert len({view.camera_id for view in views}) == len(static_cameras(views)) == 4
    assert capture.times_in_seconds
    # all of them run from the last start, 0.37 s, to the first end, 2.3 s
    assert capture.seconds == pytest.approx(1.93, abs=0.16)
    written = json.loads((capture_root / "times.json").read_text())["seconds"]
    assert sorted(written) == sorted(f"{view.name}.png" for view in views)
    assert capture.file_time_span == pytest.approx((min(written.values()), max(written.values())))


def test_a_camera_that_moves_is_refused(tmp_path: Path) -> None:
    write_videos(tmp_path / "rig", {"a": 40.0}, {"a": 0.0}, 10.0, 8)
    with video_writer(tmp_path / "rig" / "walking.mp4", fps=10) as add:
        for i in range(8):
            add(corner(camera(30.0 + 2 * i), 0.0))
    with pytest.raises(
        DyngsError, match=r"cameras of several videos must be fixed, but these move: walking"
    ):
        poses_of_videos(tmp_path / "rig", tmp_path / "out", SfmOptions(num_threads=1))
    assert not (tmp_path / "out").exists()


NAMES = ["left", "right"]


def _written(folder: Path, value: object) -> Path:
    (folder / VIDEOS_FILE).write_text(json.dumps(value))
    return folder


def test_starts_and_test_cameras(tmp_path: Path) -> None:
    _written(tmp_path, {"starts": {"left": 0, "right": 1.25}, "test": ["left"]})
    assert read_video_settings(tmp_path, NAMES) == ({"left": 0.0, "right": 1.25}, ["left"])


@pytest.mark.parametrize(
    ("value", "message"),
    [
        *(
            ({"starts": starts}, r"give the start of each video in seconds, for left, right")
            for starts in (
                3,
                {"left": 0},
                {"left": 0, "right": 0, "top": 1},
                {"left": 0, "right": "soon"},
                {"left": 0, "right": 1e300},
            )
        ),
        *(
            (value, r"'test', a list of some of the cameras left, right")
            for value in (
                {"start": 0},
                {"test": ["top"]},
                {"test": [{}]},
                {"test": 3},
                {"test": NAMES},
            )
        ),
    ],
)
def test_mistakes_are_named(tmp_path: Path, value: object, message: str) -> None:
    with pytest.raises(DyngsError, match=message):
        read_video_settings(_written(tmp_path, value), NAMES)


HERTZ = 16000


def _clatter(seconds: float) -> np.ndarray:
    """Return the samples of noises that begin at random times, each of another colour."""
    rng = np.random.default_rng(5)
    sound = 0.003 * rng.normal(size=int(seconds * HERTZ))
    for begin in rng.uniform(0, seconds - 0.3, int(6 * seconds)):
        at = np.arange(int(0.2 * HERTZ))
        tone = np.sin(2 * np.pi * rng.uniform(100, 3000) * at / HERTZ) * np.exp(
            -at / (0.03 * HERTZ)
        )
        sound[int(begin * HERTZ) :][: len(at)] += 0.3 * tone
    return sound


def _write(path: Path, sound: np.ndarray | None, count: int = 40) -> Path:
    """Write a grey video at 10 frames per second with a track of sound."""
    with av.open(str(path), "w") as container:
        image = container.add_stream("libx264", rate=10)
        image.width = image.height = 32
        image.pix_fmt = "yuv420p"
        audio = (
            container.add_stream("aac", rate=HERTZ, layout="mono") if sound is not None else None
        )
        for _ in range(count):
            frame = av.VideoFrame.from_ndarray(np.full((32, 32, 3), 90, np.uint8), format="rgb24")
            container.mux(image.encode(frame))
        container.mux(image.encode(None))
        if audio is not None and sound is not None:
            for begin in range(0, len(sound), 1024):
                block = av.AudioFrame.from_ndarray(
                    sound[None, begin : begin + 1024].astype(np.float32), "fltp", "mono"
                )
                block.sample_rate, block.pts = HERTZ, begin
                container.mux(audio.encode(block))
            container.mux(audio.encode(None))
    return path


def test_offsets_of_recordings_with_noise_of_their_own(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    clatter = _clatter(6.0)
    starts = [0.0, 1.23, 0.4]
    parts = [clatter[int(start * HERTZ) :][: 4 * HERTZ] for start in starts]
    noisy = [
        gain * part + 0.01 * rng.normal(size=len(part))
        for gain, part in zip((1.0, 0.3, 0.6), parts, strict=True)
    ]
    films = [open_video(_write(tmp_path / f"{i}.mp4", sound)) for i, sound in enumerate(noisy)]
    seconds, line = estimate_starts_by_sound(films)
    assert list(seconds.values()) == pytest.approx(starts, abs=0.015)
    assert "from sound (3 of 3 pairs agree" in line


def _smooth_noise(rng: np.random.Generator, length: int, bins: int = 6) -> np.ndarray:
    kernel = np.exp(-0.5 * (np.arange(-9, 10) / 3.0) ** 2)
    return np.stack(
        [np.convolve(rng.normal(size=length), kernel, "same") for _ in range(bins)], axis=1
    )


def _shown(signal: np.ndarray, begin: float, length: int) -> np.ndarray:
    """Return part of a signal that begins between samples."""
    at = begin + np.arange(length)
    return np.stack([np.interp(at, np.arange(len(column)), column) for column in signal.T], axis=1)


@pytest.mark.parametrize("shift", [0.0, 7.0, -12.4])
def test_a_shift_is_found_to_half_a_sample(shift: float) -> None:
    signal = _smooth_noise(np.random.default_rng(0), 600)
    samples, peak, deviations = estimate_shift(
        _shown(signal, 30, 420), _shown(signal, 30 + shift, 400)
    )
    assert samples == pytest.approx(shift, abs=0.5)
    assert peak > 0.9
    assert deviations > 6
    unrelated = _smooth_noise(np.random.default_rng(1), 400)
    assert estimate_shift(signal, unrelated)[2] < 6


def _videos(*clips: tuple[float, int]) -> list[CameraVideo]:
    """Videos of these frames per second and numbers of frames."""
    return [
        CameraVideo(str(i), Path(), VideoInfo(4, 4, count, rate), np.arange(count) / rate)
        for i, (rate, count) in enumerate(clips)
    ]


def test_frames_of_time_steps() -> None:
    """Of one time step they have one time; the slower video has the steps; others keep their
    time."""
    frames, line = frames_at_steps(Path("rig"), _videos((10, 30), (10, 30)), {"0": 0.0, "1": 0.5})
    assert list(frames[0]) == list(range(5, 30))
    assert list(frames[1]) == list(range(25))
    assert (
        list(frames[0].values())
        == list(frames[1].values())
        == pytest.approx(0.5 + np.arange(25) / 10)
    )
    assert "25 time steps over 2.40 s" in line
    together = {"0": 0.0, "1": 0.0}
    frames, _ = frames_at_steps(Path("rig"), _videos((50, 100), (25, 50)), together)
    assert list(frames[0]) == list(range(0, 100, 2))
    frames, _ = frames_at_steps(Path("rig"), _videos((10, 20), (10, 20)), {"0": 0.0, "1": 0.04})
    assert np.subtract(*map(list, map(dict.values, frames[::-1]))) == pytest.approx(0.04)
    frames, line = frames_at_steps(Path("rig"), _videos((30, 3000), (30, 3000)), together)
    assert len(frames[0]) == 300
    assert "of 3000" in line
    with pytest.raises(DyngsError, match="do not overlap in time"):
        frames_at_steps(Path("rig"), _videos((10, 20), (10, 20)), {"0": 0.0, "1": 5.0})
