"""Paths that were given where something else belongs."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.io.outputs import suggest_command


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Photos, a video, a folder of videos, a run and a capture, with empty files."""
    for name in (
        "photos/a.jpg",
        "photos/b.JPG",
        "photos/c.png",
        "clip.mp4",
        "rig/left.mp4",
        "rig/right.mov",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    for name in (
        "run/config.yaml",
        "capture/transforms.json",
        "single/clip.mp4",
        "empty/notes.txt",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("path", "command"),
    [
        ("photos", "`dyngs train photos`"),
        ("clip.mp4", "`dyngs train clip.mp4`"),
        ("rig", "2 videos, train it with `dyngs train rig`"),
        ("run", "`dyngs eval run`"),
        ("capture", "`dyngs train capture`"),
        ("single", "one video"),
        ("empty", None),
        ("empty/notes.txt", None),
        ("nowhere", None),
    ],
)
@pytest.mark.usefixtures("workplace")
def test_the_command_for_a_path(path: str, command: str | None) -> None:
    found = suggest_command(Path(path))
    assert found is None if command is None else command in (found or "")
