"""Photos and videos that are given as captures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_captures import write_colmap

from dyngs.capture.sfm import unposed
from dyngs.capture.sfm.colmap import SfmOptions
from dyngs.capture.sfm.estimate import SfmResult
from dyngs.capture.sfm.unposed import ensure_poses
from dyngs.cli import main
from dyngs.config import Config, DataConfig
from dyngs.config.io import save_config
from dyngs.core.errors import DyngsError
from dyngs.export.video import video_writer
from dyngs.io.outputs import SOURCES_NAME
from dyngs.io.write import cache_folder, write_image


@pytest.fixture(autouse=True)
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Replace structure from motion by a stub; return the list of its sources."""
    sources: list[Path] = []

    def estimate(source: Path, out: Path, options: SfmOptions, report: object) -> SfmResult:
        sources.append(source)
        write_colmap(out)
        return SfmResult(out, 3, 3, (), 8, 0.5, ())

    def several(source: Path, out: Path, options: SfmOptions, report: object) -> str:
        sources.append(source)
        write_colmap(out)
        return "4 of 4 cameras registered"

    monkeypatch.setattr(unposed, "estimate_poses", estimate)
    monkeypatch.setattr(unposed, "poses_of_videos", several)
    return sources


def _photos(folder: Path, count: int = 3) -> Path:
    for i in range(count):
        write_image(folder / f"photo_{i}.png", np.full((4, 6, 3), i, np.uint8))
    return folder


def _videos(folder: Path, count: int) -> Path:
    folder.mkdir()
    for i in range(count):
        (folder / f"cam{i}.mp4").write_bytes(b"")
    return folder


def test_photos_get_poses_once(tmp_path: Path, asked: list[Path]) -> None:
    said: list[str] = []
    data = DataConfig(root=_photos(tmp_path / "photos"))
    first = ensure_poses(data, log=said.append)
    assert cache_folder("poses") in first.root.parents
    assert "has no poses; estimating them" in said[0]
    assert "3 of 3 images" in said[1]
    assert ensure_poses(data, log=said.append) == first
    assert asked == [tmp_path / "photos"]
    assert "using the poses cached" in said[-1]
    write_image(tmp_path / "photos" / "photo_1.png", np.zeros((4, 8, 3), np.uint8))
    assert ensure_poses(data, log=said.append).root != first.root, "a photo has changed"
    assert len(asked) == 2


def test_no_output_replaces_the_video_that_a_run_is_made_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The run knows only the folder in the cache, which names the video."""
    video = tmp_path / "clip.mp4"
    with video_writer(video, fps=10) as add:
        add(np.zeros((16, 16, 3), np.uint8))
    before = video.read_bytes()
    for _ in ("estimated", "cached"):
        data = ensure_poses(DataConfig(root=video), log=lambda _: None)
        save_config(Config(data=data), tmp_path / "run" / "config.yaml")
        assert (
            main(["render", str(tmp_path / "run"), "--path", "along", "--video", str(video)]) == 2
        )
        assert "clip.mp4: exists, which is an input" in capsys.readouterr().err
        (data.root / SOURCES_NAME).unlink()  # as a run killed at just that moment leaves it
    assert video.read_bytes() == before


def test_what_cannot_work_is_said_before_poses_are_estimated(
    tmp_path: Path, asked: list[Path]
) -> None:
    photos = DataConfig(root=_photos(tmp_path / "photos"))
    with pytest.raises(DyngsError, match=r"no times.*data\.times=order"):
        ensure_poses(photos, needs_times=True)
    with pytest.raises(DyngsError, match=r"2 videos.*dyngs train dynamic"):
        ensure_poses(DataConfig(root=_videos(tmp_path / "rig", 2)))
    with pytest.raises(
        DyngsError, match=r"one video; give the video itself: data\.root=.*cam0\.mp4"
    ):
        ensure_poses(DataConfig(root=_videos(tmp_path / "single", 1)), needs_times=True)
    with pytest.raises(
        DyngsError, match=r"two: holds 2 photos but no cameras; a scene needs at least 3 photos"
    ):
        ensure_poses(DataConfig(root=_photos(tmp_path / "two", 2)))
    assert asked == []
    ordered = photos.model_copy(update={"times": "order"})
    assert ensure_poses(ordered, needs_times=True, log=lambda _: None).root != photos.root
