"""Exports drawn again: equal files give equal images, and what a format loses is measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from moving_scene import write_moving_run
from splat_scenes import cloud

from dyngs.export.redrawn import Redrawn, capture_cameras, compare_run, compare_splats
from dyngs.export.splat_files import Writing, write_run_splats
from dyngs.io.formats.formats import read_splats, upright, write_splats
from dyngs.io.formats.similarity import AXES, turn_between
from dyngs.io.formats.splat_file import SplatFile
from dyngs.runs.opened import open_run


def test_a_run_and_its_files(tmp_path: Path) -> None:
    run = open_run(write_moving_run(tmp_path / "run"))
    for how in (Writing(), Writing(turn_between(AXES["z"], AXES["-y"]), "-y")):
        written = write_run_splats(run, tmp_path / "a.ply", 0.7, how=how)
        read = read_splats(written.path)
        assert compare_run(run, run.scene, 0.7, written.splat, read).psnr > 80
        # another time is seen as such
        assert compare_run(run, run.scene, 0.0, written.splat, read).psnr < 40
    cameras = capture_cameras(run)
    assert cameras is not None
    assert max(cameras.width, cameras.height) <= 240


def test_what_is_lost_is_measured(tmp_path: Path) -> None:
    splat = SplatFile(cloud(300), up="z")
    exact = write_splats(tmp_path / "a.ply", upright(splat, None, tmp_path / "a.ply"))
    assert compare_splats(splat, exact).psnr > 80
    coarse = write_splats(tmp_path / "a.splat", splat)
    assert compare_splats(splat, coarse).psnr < 30
    # a file that had been turned before
    again = replace(splat, turned=turn_between(AXES["x"], AXES["z"]))
    assert (
        compare_splats(
            again, write_splats(tmp_path / "b.ply", upright(again, None, tmp_path / "b.ply"))
        ).psnr
        > 80
    )
    assert torch.isfinite(torch.tensor(compare_splats(splat, coarse).psnr))


def test_the_line() -> None:
    assert "the same images" in Redrawn(100.0, 4).line
    assert "drawn again from 4 cameras: 24.1 dB" in Redrawn(24.12, 4).line
    assert Redrawn(24.12, 4).is_faint
    assert not Redrawn(40.0, 4).is_faint
