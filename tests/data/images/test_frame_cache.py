"""Cache of video frames: only requested frames are decoded, once and within the size limit."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from tiny_captures import (
    cached,
    level_of,
    write_video,
)

from dyngs.core.errors import DyngsError
from dyngs.data.capture import VideoFrame
from dyngs.data.images import video
from dyngs.data.images.images import read_image
from dyngs.data.images.video import decode_frames, locate_cached_frames
from dyngs.io.write import cache_folder


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_video(tmp_path / "capture" / "cam00.mp4", 6)
    return tmp_path / "capture"


def plan(path: Path) -> dict[Path, VideoFrame]:
    """All frames of a video."""
    return {image: VideoFrame(path, i) for i, image in enumerate(locate_cached_frames(path).paths)}


def some(frames: dict[Path, VideoFrame], *numbers: int) -> dict[Path, VideoFrame]:
    return {path: frame for path, frame in frames.items() if frame.number in numbers}


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*.png"))


def test_only_wanted_frames_are_written_and_none_to_the_capture(root: Path) -> None:
    frames = plan(root / "cam00.mp4")
    decode_frames(root, some(frames, 4, 1))
    assert files(cache_folder("frames")) == ["frame_000001.png", "frame_000004.png"]
    assert [path.name for path in root.iterdir()] == ["cam00.mp4"]
    for path, frame in some(frames, 4, 1).items():
        pixels = read_image(path).numpy().astype(int)
        assert pixels.shape == (12, 16, 3)
        assert np.abs(pixels - level_of(frame.number)).max() <= 6


def test_frames_are_found_again_also_of_a_copy(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = plan(root / "cam00.mp4")
    decode_frames(root, some(frames, 0, 1, 2))
    asked = []
    real = video.read_numbered_frames
    monkeypatch.setattr(
        video,
        "read_numbered_frames",
        lambda path, numbers: asked.extend(numbers) or real(path, numbers),
    )
    monkeypatch.setattr(video, "probe_video", lambda path: pytest.fail("what it says is stored"))
    shutil.copytree(root, tmp_path / "copy")
    copied = plan(tmp_path / "copy" / "cam00.mp4")
    assert list(copied) == list(frames)
    decode_frames(tmp_path / "copy", some(copied, 0, 1, 2))
    assert asked == []
    decode_frames(root, some(frames, 0, 1, 2, 3, 4))
    assert asked == [3, 4]


def test_another_video_under_the_same_name(root: Path) -> None:
    """Neither its size nor its frames are mixed up with the former one's, even if size and time are
    the same."""
    source = root / "cam00.mp4"
    before = locate_cached_frames(source)
    decode_frames(root, plan(source))
    status = source.stat()
    data = bytearray(source.read_bytes())
    data[-1] ^= 1
    source.write_bytes(data)
    os.utime(source, ns=(status.st_atime_ns, status.st_mtime_ns))
    video._digest.cache_clear()
    assert not set(locate_cached_frames(source).paths) & set(before.paths)
    write_video(source, 4, size=(32, 16))
    frames = locate_cached_frames(source)
    assert (frames.info.width, frames.info.num_frames) == (32, 4)
    decode_frames(root, some(plan(source), 0, 1))
    assert read_image(frames.paths[0]).shape == (16, 32, 3)


def test_the_limit_is_refused_at_once(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = plan(root / "cam00.mp4")
    decode_frames(root, some(frames, 0))
    one = next(iter(frames)).stat().st_size
    monkeypatch.setattr(video, "MAX_CACHED_BYTES", 3 * one)
    with pytest.raises(DyngsError, match=r"bytes of video frames exceed the limit.*DYNGS_LIMITS="):
        decode_frames(root, frames)
    assert len(cached()) <= 2, "the estimate is made from the first frame"


def test_least_recently_used_frames_are_evicted(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames that were used in the last days stay, and so do folders without our mark."""
    for name in ("cam01", "cam02", "cam03"):
        shutil.copy(root / "cam00.mp4", root / f"{name}.mp4")
    oldest, old, recent, new = (plan(root / f"cam0{i}.mp4") for i in range(4))
    for frames in (oldest, old, recent):
        decode_frames(root, frames)
    for age, frames in ((100, oldest), (200, old)):
        os.utime(next(iter(frames)).parent / "video.json", (age, age))
    unmarked = cache_folder("frames") / "cam00.0123"
    unmarked.mkdir()
    (unmarked / "frame_000000.png").write_text("mine")
    monkeypatch.setattr(video, "MAX_CACHED_BYTES", sum(p.stat().st_size for p in cached()))
    decode_frames(root, new)
    found = [any(path.exists() for path in frames) for frames in (oldest, old, recent, new)]
    assert found == [False, True, True, True]
    assert (unmarked / "frame_000000.png").read_text() == "mine"
