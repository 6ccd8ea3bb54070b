"""Paths that were given where something else belongs."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.cli import main
from dyngs.io.wrong_place import command_for


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
        ("photos", "`dyngs train static data.root=photos`"),
        ("clip.mp4", "`dyngs train dynamic data.root=clip.mp4`"),
        ("rig", "2 videos, make a scene of them with `dyngs train dynamic data.root=rig`"),
        ("run", "`dyngs eval run`"),
        ("capture", "`dyngs train static data.root=capture`"),
        ("single", "one video"),
        ("empty", None),
        ("empty/notes.txt", None),
        ("nowhere", None),
    ],
)
@pytest.mark.usefixtures("workplace")
def test_the_command_for_a_path(path: str, command: str | None) -> None:
    found = command_for(Path(path))
    assert found is None if command is None else command in (found or "")


@pytest.mark.parametrize(
    ("words", "command"),
    [
        ("eval photos", "dyngs train static data.root=photos"),
        ("eval clip.mp4", "dyngs train static data.root=clip.mp4"),
        ("eval static", "dyngs train static data.root=FOLDER"),
        ("render photos", "dyngs train static data.root=photos"),
        ("render clip.mp4 --out images", "dyngs train static data.root=clip.mp4"),
        ("export rig", "dyngs train dynamic data.root=rig"),
        ("view rig", "dyngs train dynamic data.root=rig"),
        ("view clip.mp4", "dyngs train static data.root=clip.mp4"),
        ("train photos", "dyngs train static data.root=photos"),
        ("train clip.mp4", "dyngs train static data.root=clip.mp4"),
        ("train run", "dyngs train --resume run"),
        ("train static photos", "data.root=photos"),
        ("train static data.root=run", "dyngs eval"),
        ("train static data.root=rig", "dyngs train dynamic data.root="),
        ("train static data.root=single", "data.root="),
        ("train human data.root=photos", "install MediaPipe"),
        ("train mcmc data.root=photos", "'static_mcmc'"),
        ("train statc data.root=photos", "'static'"),
        ("train 4dgs data.root=photos", "'dynamic'"),
        ("data inspect photos", "dyngs train static data.root=photos"),
        ("inspect photos", "dyngs data inspect"),
        ("sfm photos out", "dyngs data sfm"),
    ],
)
@pytest.mark.usefixtures("workplace")
def test_wrong_starts_name_the_right_command(
    words: str, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words.split()) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert command in error
