"""Opened scenes: what is known about a run, an avatar or a file, and that a capture is read once,
when it is needed."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from moving_scene import write_moving_run
from two_balls import two_balls

from dyngs.core.errors import DyngsError
from dyngs.io.formats.formats import write_splats
from dyngs.io.formats.splat_file import SplatFile
from dyngs.runs.opened import FRAME_RATE, SHORTEST, OpenedScene, open_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_moving_run(tmp_path_factory.mktemp("run"), offset=(1.0, 2.0, 3.0))


def test_without_its_capture_a_run_is_opened_all_the_same(tmp_path: Path) -> None:
    folder = write_moving_run(tmp_path)
    shutil.rmtree(tmp_path / "capture")
    opened = open_scene(folder)
    assert opened.missing is not None
    assert (opened.cameras, opened.up) == (None, None)
    assert opened.seconds == max(len(opened.scene.times) / FRAME_RATE, SHORTEST)
    with pytest.raises(DyngsError, match="capture"):
        _ = opened.capture


def test_who_says_what_is_up(folder: Path) -> None:
    opened = open_scene(folder)
    assert opened.up is not None
    assert opened.up[1] == "the mean camera"
    assert np.linalg.norm(opened.up[0]) == pytest.approx(1)
    told = replace(opened, stated_up="-y").up
    assert told is not None
    assert (told[0].tolist(), told[1]) == ([0, -1, 0], "the file")


@pytest.mark.parametrize("name", ["a.ply", "a.spz"])
def test_a_file_has_no_capture(name: str, tmp_path: Path) -> None:
    write_splats(tmp_path / name, SplatFile(two_balls()))
    opened = open_scene(tmp_path / name)
    assert (opened.name, opened.captured, opened.cameras) == (name, None, None)
    assert opened.background.tolist() == [0, 0, 0]
    assert opened.scene.is_static
    with pytest.raises(DyngsError, match=f"{name}: a file, without the capture"):
        _ = opened.capture


def test_another_background_is_drawn(folder: Path) -> None:
    opened = open_scene(folder)
    black = opened.on_background("black")
    camera = opened.cameras.select(0) if opened.cameras is not None else pytest.fail("no cameras")
    white, dark = (one.scene.render(camera, 0.0).rgb.detach() for one in (opened, black))
    assert float((white - dark).min()) >= -1e-6
    assert torch.equal(
        white, opened.scene.render(camera, 0.0, background=torch.ones(3)).rgb.detach()
    )
    assert float((white - dark).max()) == pytest.approx(1, abs=1e-3)


def test_only_people_play_motions(folder: Path) -> None:
    run: OpenedScene = open_scene(folder)
    with pytest.raises(
        DyngsError, match=r"--motion walk.npz needs the run of a person \(model.kind=human\)"
    ):
        run.play_motion(Path("walk.npz"))
    with pytest.raises(DyngsError, match="--pose rest needs the run of a person"):
        run.at_rest()


def test_anything_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no scene")
    with pytest.raises(DyngsError, match=r"notes\.txt: not a scene"):
        open_scene(tmp_path / "notes.txt")
    with pytest.raises(DyngsError, match="no such file"):
        open_scene(tmp_path / "nothing")
