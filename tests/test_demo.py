"""The demo: everything that it promises lies there, and earlier results stay."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dyngs.cli import demo, main
from dyngs.io.outputs import LOCK_NAME


def test_everything_that_is_promised_lies_there_and_the_command_prints_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, "SIZE", 24)
    monkeypatch.setattr(demo, "NUM_POINTS", 300)
    (tmp_path / "a: b").mkdir()
    (tmp_path / "a: b" / "mine").touch()
    assert main(["demo", "--out", str(tmp_path / "a: b"), "--steps", "30", "--threads", "1"]) == 0
    folder = tmp_path / "a: b-2"
    text = capsys.readouterr().out
    for name in ("run", "images/sheet.png", "orbit.mp4", "splats.ply"):
        assert (folder / name).exists()
        assert str(folder / name) in text
    report = json.loads((folder / "run" / "metrics.json").read_text())
    assert report["step"] == 30
    assert f"{report['psnr']:.2f} dB" in text


def test_only_an_empty_folder_is_taken(tmp_path: Path) -> None:
    assert demo.is_unused(tmp_path / "new")
    (tmp_path / LOCK_NAME).touch()  # of one that was killed
    assert demo.is_unused(tmp_path)
    (tmp_path / "mine").touch()
    assert not demo.is_unused(tmp_path)
    assert not demo.is_unused(tmp_path / "mine")
