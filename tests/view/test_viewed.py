import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from moving_scene import TEST_TIMES, TRAIN_TIMES, row_of_balls, write_moving_run

from dyngs.errors import DyngsError
from dyngs.splats.formats import write_splats
from dyngs.splats.splat_file import SplatFile
from dyngs.view.viewed import load_viewed


def test_a_run_has_the_cameras_times_and_background_of_its_capture(tmp_path: Path) -> None:
    viewed = load_viewed(write_moving_run(tmp_path))
    assert sorted(time for time in viewed.footage.times if time is not None) == sorted(TRAIN_TIMES + TEST_TIMES)
    assert not viewed.is_static
    assert viewed.has_timeline
    assert viewed.background.tolist() == [1, 1, 1]
    assert torch.equal(viewed.start.cam_from_world, viewed.footage.cameras[0].cam_from_world)
    assert np.linalg.norm(viewed.up) == pytest.approx(1)
    assert viewed.footage.thumbnails is not None
    assert viewed.notes == ()


def test_a_run_without_its_capture_is_shown_all_the_same(tmp_path: Path) -> None:
    run = write_moving_run(tmp_path, offset=(1.0, 2.0, 3.0))
    shutil.rmtree(tmp_path / "capture")
    viewed = load_viewed(run, "-y")
    assert len(viewed.footage) == 0
    assert "without the capture" in viewed.notes[0]
    assert viewed.up.tolist() == [0, -1, 0]
    assert viewed.world_offset.tolist() == [1, 2, 3]


@pytest.mark.parametrize("name", ["balls.ply", "balls.spz", "balls.splat"])
def test_a_file_is_seen_from_where_all_of_it_is_in_view(tmp_path: Path, name: str) -> None:
    write_splats(tmp_path / name, SplatFile(row_of_balls(201)))
    viewed = load_viewed(tmp_path / name)
    assert viewed.is_static
    assert not viewed.has_timeline
    places = viewed.start.cam_from_world[0, :3, :3] @ viewed.scene.gaussians.means.T
    shown = viewed.start.intrinsics[0] @ (places + viewed.start.cam_from_world[0, :3, 3:])
    pixels = shown[:2] / shown[2]
    assert bool((shown[2] > 0).all())
    inside = (pixels >= 0).all(0) & (pixels[0] <= 960) & (pixels[1] <= 720)
    assert float(inside.float().mean()) > 0.95


def test_anything_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no scene")
    with pytest.raises(DyngsError, match=r"notes\.txt"):
        load_viewed(tmp_path / "notes.txt")
