"""Frames of videos on disk: those asked for, once, within the limit."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from tiny_captures import level_of, truncate_video, write_video

from dyngs.data import frame_cache
from dyngs.data.frame_cache import decode_frames, is_video_frame, planned_frames
from dyngs.data.images import read_picture
from dyngs.errors import DyngsError


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_video(tmp_path / "capture" / "cam00.mp4", 6)
    return tmp_path / "capture"


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*.png"))


def test_planning_writes_nothing(root: Path) -> None:
    frames = planned_frames(root, root / "cam00.mp4")
    assert (frames.info.width, frames.info.height, frames.info.num_frames, frames.info.fps) == (16, 12, 6, 30.0)
    assert len(set(frames.paths)) == 6
    assert all(is_video_frame(path) and root in path.parents for path in frames.paths)
    assert [path.name for path in root.iterdir()] == ["cam00.mp4"]


def test_only_wanted_frames_are_written(root: Path) -> None:
    paths = planned_frames(root, root / "cam00.mp4").paths
    decode_frames(root, [paths[4], paths[1], root / "a picture.png", paths[1]], 10)
    assert files(root) == ["frame_000001.png", "frame_000004.png"]
    for number in (1, 4):
        pixels = read_picture(paths[number]).numpy().astype(int)
        assert pixels.shape == (12, 16, 3)
        assert np.abs(pixels - level_of(number)).max() <= 6


def test_frames_are_found_again(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = planned_frames(root, root / "cam00.mp4").paths
    decode_frames(root, paths[:3], 10)
    asked = []
    real = frame_cache.read_numbered_frames
    monkeypatch.setattr(
        frame_cache, "read_numbered_frames", lambda path, numbers: asked.append(list(numbers)) or real(path, numbers)
    )
    monkeypatch.setattr(frame_cache, "probe_video", lambda path: pytest.fail("what it says is stored"))
    assert planned_frames(root, root / "cam00.mp4").paths == paths
    decode_frames(root, paths[:3], 10)
    assert asked == []
    monkeypatch.undo()
    monkeypatch.setattr(
        frame_cache, "read_numbered_frames", lambda path, numbers: asked.append(list(numbers)) or real(path, numbers)
    )
    decode_frames(root, paths[:5], 10)
    assert asked == [[3, 4]]


def test_another_video_under_the_same_name(root: Path) -> None:
    """Neither its size nor its frames are mixed up with the former one's, whose frames go."""
    decode_frames(root, planned_frames(root, root / "cam00.mp4").paths, 10)
    write_video(root / "cam00.mp4", 4, size=(32, 16))
    frames = planned_frames(root, root / "cam00.mp4")
    assert (frames.info.width, frames.info.num_frames) == (32, 4)
    assert not any(path.exists() for path in frames.paths)
    decode_frames(root, frames.paths[:2], 10)
    assert files(root) == ["frame_000000.png", "frame_000001.png"]
    assert read_picture(frames.paths[0]).shape == (16, 32, 3)


def test_the_limit_is_refused_at_once(root: Path) -> None:
    paths = planned_frames(root, root / "cam00.mp4").paths
    decode_frames(root, paths[:1], 10)
    one_mb = paths[0].stat().st_size / 1e6
    with pytest.raises(DyngsError, match=r"need about .* MB on disk.*data\.frame_cache_mb is .*raise it.*data\.frames"):
        decode_frames(root, paths, 3 * one_mb)
    assert len(files(root)) <= 2, "the estimate is made from the first frame"
    decode_frames(root, paths, 8 * one_mb)
    assert len(files(root)) == 6
    write_video(root / "cam01.mp4", 6)
    with pytest.raises(DyngsError, match=r"holds .* MB already"):
        decode_frames(root, planned_frames(root, root / "cam01.mp4").paths, 8 * one_mb)


def test_a_full_disk_is_refused_at_once(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(root)
    monkeypatch.setattr(frame_cache.shutil, "disk_usage", lambda _: usage._replace(free=10))
    with pytest.raises(DyngsError, match=r"the disk has only .* left"):
        decode_frames(root, planned_frames(root, root / "cam00.mp4").paths, 100)
    assert len(files(root)) == 1


def test_a_read_only_capture_uses_the_users_cache(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decode_frames(root, planned_frames(root, root / "cam00.mp4").paths[:1], 10)
    access = os.access
    monkeypatch.setattr(
        os, "access", lambda path, mode: root not in (p := Path(path), *p.parents) and access(path, mode)
    )
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    paths = planned_frames(root, root / "cam00.mp4").paths
    assert paths[0].is_file(), "what came with the capture is used"
    assert root in paths[0].parents
    decode_frames(root, paths[:3], 10)
    assert files(root) == ["frame_000000.png"]
    assert files(tmp_path / "cache") == ["frame_000001.png", "frame_000002.png"]
    assert all(is_video_frame(path) for path in paths)


def test_a_damaged_note_is_ignored(root: Path) -> None:
    paths = planned_frames(root, root / "cam00.mp4").paths
    decode_frames(root, paths[:1], 10)
    for text in ("", "[]", '{"width": "x"}', '{"width": 16}'):
        (paths[0].parent / "video.json").write_text(text)
        assert planned_frames(root, root / "cam00.mp4").paths == paths


def test_a_truncated_video_is_named(root: Path) -> None:
    video = root / "cam00.mp4"
    truncate_video(video, 4)
    frames = planned_frames(root, video)
    with pytest.raises(DyngsError, match=r"cam00\.mp4 breaks at frame \d"):
        decode_frames(root, frames.paths, 10)
    for path in frames.paths:
        if path.is_file():
            assert read_picture(path).shape == (12, 16, 3)
    assert not list(root.rglob(".frame*"))
