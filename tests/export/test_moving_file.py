"""Moving scenes as one .4dgs, read back by the reader of the package that defines the format."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from moving_scene import moved_x, write_moving_run

from dyngs.cli import main
from dyngs.errors import DyngsError
from dyngs.export import moving_file
from dyngs.export.moving_file import read_moment, write_moving
from dyngs.runs.checkpoint import load_run


def test_every_moment_is_where_it_should_be(tmp_path: Path) -> None:
    pytest.importorskip("fourdgs")
    run = load_run(write_moving_run(tmp_path / "run"))
    times = [i / 9 for i in range(10)]  # more than one group of key frame and deltas
    written = write_moving(run, tmp_path / "a.4dgs", times)
    for i in (0, 3, 8, 9):
        read = read_moment(written.path, i).gaussians
        torch.testing.assert_close(read.means[:, 0], moved_x((0, 1, 2, 3, 4), times[i]), rtol=0, atol=0.01)
        torch.testing.assert_close(read.base_rgb, written.splats[i].gaussians.base_rgb.clamp(0, 1), rtol=0, atol=0.01)
        torch.testing.assert_close(read.scales, written.splats[i].gaussians.scales, rtol=0.02, atol=0)


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("fourdgs")
    run = write_moving_run(tmp_path / "run")
    assert main(["export", str(run), "--times", "0:1:3", "--out", str(tmp_path / "a.4dgs")]) == 0
    said = capsys.readouterr().out
    assert "3 times, each shown for 1/30 s" in said
    assert "drawn again from 4 cameras" in said
    assert main(["export", str(run), "--format", "4dgs", "--out", str(tmp_path / "b")]) == 2
    assert main(["export", str(run), "--sh-degree", "3", "--out", str(tmp_path / "a.4dgs")]) == 2


def test_without_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    run = load_run(write_moving_run(tmp_path / "run"))
    monkeypatch.setattr(moving_file, "import_module", missing)
    with pytest.raises(DyngsError, match=r"pip install 'dyngs\[4dgs\]'"):
        write_moving(run, tmp_path / "a.4dgs", [0.0])
