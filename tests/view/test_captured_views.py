import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from moving_scene import TEST_TIMES, TRAIN_TIMES, row_of_balls, write_moving_run

from dyngs.io.formats.formats import write_splats
from dyngs.io.formats.splat_file import SplatFile
from dyngs.runs.opened import open_scene
from dyngs.view.captured_views import has_timeline, viewpoint_of, views_of
from dyngs.view.source import open_to_view


def test_a_run_has_the_cameras_and_times_of_its_capture(tmp_path: Path) -> None:
    opened = open_scene(write_moving_run(tmp_path))
    shown = views_of(opened)
    begin = viewpoint_of(opened)
    assert sorted(time for time in shown.times if time is not None) == sorted(
        TRAIN_TIMES + TEST_TIMES
    )
    assert not opened.scene.is_static
    assert has_timeline(opened)
    assert torch.equal(begin.start.cam_from_world, shown.cameras[0].cam_from_world)
    assert np.linalg.norm(begin.up) == pytest.approx(1)
    assert shown.thumbnails is not None
    assert views_of(replace(opened, as_captured=False)).images is None


def test_a_run_without_its_capture_is_shown_all_the_same(tmp_path: Path) -> None:
    run = write_moving_run(tmp_path, offset=(1.0, 2.0, 3.0))
    shutil.rmtree(tmp_path / "capture")
    opened = open_to_view(run, "run", "-y")
    assert len(views_of(opened)) == 0
    assert "without the capture" in opened.notes[0]
    assert viewpoint_of(opened).up.tolist() == [0, -1, 0]


@pytest.mark.parametrize("name", ["balls.ply", "balls.spz", "balls.splat"])
def test_a_file_is_seen_from_where_all_of_it_is_in_view(tmp_path: Path, name: str) -> None:
    write_splats(tmp_path / name, SplatFile(row_of_balls(201)))
    opened = open_to_view(tmp_path / name, name)
    start = viewpoint_of(opened).start
    assert not has_timeline(opened)
    places = start.cam_from_world[0, :3, :3] @ opened.scene.gaussians.means.T
    shown = start.intrinsics[0] @ (places + start.cam_from_world[0, :3, 3:])
    pixels = shown[:2] / shown[2]
    assert bool((shown[2] > 0).all())
    inside = (pixels >= 0).all(0) & (pixels[0] <= 960) & (pixels[1] <= 720)
    assert float(inside.float().mean()) > 0.95
