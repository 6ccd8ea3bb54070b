"""Frames of videos in the user's cache: those asked for, once, within the limit; nothing else is
ever removed."""

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
from dyngs.data.images import frame_cache
from dyngs.data.images.frame_cache import decode_frames, planned_frames
from dyngs.data.images.images import read_image
from dyngs.io.write import cache_folder


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_video(tmp_path / "capture" / "cam00.mp4", 6)
    return tmp_path / "capture"


def plan(video: Path) -> dict[Path, VideoFrame]:
    """All frames of a video."""
    return {path: VideoFrame(video, i) for i, path in enumerate(planned_frames(video).paths)}


def some(frames: dict[Path, VideoFrame], *numbers: int) -> dict[Path, VideoFrame]:
    return {path: frame for path, frame in frames.items() if frame.number in numbers}


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*.png"))


def forget() -> None:
    """As if another process had decoded what is in the cache."""
    for mark in frame_cache._locked.values():
        mark.close()
    frame_cache._locked.clear()


def test_only_wanted_frames_are_written_and_none_to_the_capture(root: Path) -> None:
    frames = plan(root / "cam00.mp4")
    decode_frames(root, some(frames, 4, 1), 10)
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
    decode_frames(root, some(frames, 0, 1, 2), 10)
    asked = []
    real = frame_cache.read_numbered_frames
    monkeypatch.setattr(
        frame_cache,
        "read_numbered_frames",
        lambda path, numbers: asked.append(list(numbers)) or real(path, numbers),
    )
    monkeypatch.setattr(
        frame_cache, "probe_video", lambda path: pytest.fail("what it says is stored")
    )
    shutil.copytree(root, tmp_path / "copy")
    copied = plan(tmp_path / "copy" / "cam00.mp4")
    assert list(copied) == list(frames)
    decode_frames(tmp_path / "copy", some(copied, 0, 1, 2), 10)
    assert asked == []
    decode_frames(root, some(frames, 0, 1, 2, 3, 4), 10)
    assert asked == [[3, 4]]


def test_another_video_under_the_same_name(root: Path) -> None:
    """Neither its size nor its frames are mixed up with the former one's, even if size and time are
    the same."""
    video = root / "cam00.mp4"
    before = planned_frames(video)
    decode_frames(root, plan(video), 10)
    status = video.stat()
    data = bytearray(video.read_bytes())
    data[-1] ^= 1
    video.write_bytes(data)
    os.utime(video, ns=(status.st_atime_ns, status.st_mtime_ns))
    frame_cache._digest.cache_clear()
    assert not set(planned_frames(video).paths) & set(before.paths)
    write_video(video, 4, size=(32, 16))
    frames = planned_frames(video)
    assert (frames.info.width, frames.info.num_frames) == (32, 4)
    decode_frames(root, some(plan(video), 0, 1), 10)
    assert read_image(frames.paths[0]).shape == (16, 32, 3)


def test_the_limit_is_refused_at_once(root: Path) -> None:
    frames = plan(root / "cam00.mp4")
    decode_frames(root, some(frames, 0), 10)
    one_mb = next(iter(frames)).stat().st_size / 1e6
    with pytest.raises(
        DyngsError, match=r"need about .* MB on disk, of which .* MB are there.*raise"
    ):
        decode_frames(root, frames, 3 * one_mb)
    assert len(cached()) <= 2, "the estimate is made from the first frame"
    decode_frames(root, frames, 20 * one_mb)
    assert len(cached()) == 6


def test_what_was_not_used_for_longest_makes_room(root: Path) -> None:
    for name in ("cam01", "cam02"):
        shutil.copy(root / "cam00.mp4", root / f"{name}.mp4")
    old, used, new = (plan(root / f"cam0{i}.mp4") for i in range(3))
    decode_frames(root, old, 10)
    decode_frames(root, used, 10)
    forget()
    for age, frames in ((100, old), (200, used)):
        os.utime(next(iter(frames)).parent / "video.json", (age, age))
    decode_frames(root, used, 10)
    forget()
    size_mb = sum(path.stat().st_size for path in cached()) / 2e6
    decode_frames(root, new, 2.5 * size_mb)
    assert [any(path.exists() for path in frames) for frames in (old, used, new)] == [
        False,
        True,
        True,
    ]
    assert not next(iter(old)).parent.exists()


def test_frames_that_another_process_reads_stay(root: Path) -> None:
    """A lock is one of an open file: what was locked here, and is no longer known, is as locked by
    another process."""
    shutil.copy(root / "cam00.mp4", root / "cam01.mp4")
    decode_frames(root, plan(root / "cam00.mp4"), 10)
    held = [*frame_cache._locked.values()]
    frame_cache._locked.clear()
    size_mb = sum(path.stat().st_size for path in cached()) / 1e6
    with pytest.raises(DyngsError, match=r"frames of other videos, which are in use, take .* MB"):
        decode_frames(root, plan(root / "cam01.mp4"), 1.5 * size_mb)
    assert all(path.is_file() for path in plan(root / "cam00.mp4"))
    for mark in held:
        mark.close()
    decode_frames(root, plan(root / "cam01.mp4"), 1.5 * size_mb)
    assert not any(path.is_file() for path in plan(root / "cam00.mp4"))


def test_nothing_but_our_own_is_removed_from_the_cache(root: Path, tmp_path: Path) -> None:
    """Not folders without our mark, not what a link leads to, not files of others in a folder of
    ours."""
    decode_frames(root, plan(root / "cam00.mp4"), 10)
    ours = next(iter(plan(root / "cam00.mp4"))).parent
    (ours / "letter.txt").write_text("dear")
    (ours / "link").symlink_to(tmp_path)
    unmarked = cache_folder("frames") / "cam00.0123"
    unmarked.mkdir()
    (unmarked / "frame_000000.png").write_text("mine")
    linked = tmp_path / "documents"
    shutil.copytree(ours, linked, symlinks=True)
    (cache_folder("frames") / "cam01.0123").symlink_to(linked)
    shutil.copy(root / "cam00.mp4", root / "new.mp4")
    forget()
    size_mb = sum(path.stat().st_size for path in plan(root / "cam00.mp4")) / 1e6
    decode_frames(root, plan(root / "new.mp4"), 1.2 * size_mb)
    assert files(ours) == []
    assert (ours / "letter.txt").read_text() == "dear"
    assert (unmarked / "frame_000000.png").read_text() == "mine"
    assert len(files(linked)) == 6
