"""Render jobs of runs: times along paths, views that stand still, and how they are named."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from moving_scene import TEST_TIMES, TRAIN_TIMES, write_moving_run

from dyngs.config import DataConfig
from dyngs.data.capture import Capture
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError
from dyngs.output.camera_paths import CameraPath, write_path
from dyngs.output.job_of_run import cameras_for_paths, job_of_run, view_to_show
from dyngs.output.render_job import RenderJobOptions


@pytest.fixture(scope="module")
def moving_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_moving_run(tmp_path_factory.mktemp("moving"))


@pytest.fixture(scope="module")
def still_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_moving_run(tmp_path_factory.mktemp("still"), moves=False)


def capture_of(run_dir: Path) -> Capture:
    return read_capture(DataConfig.model_validate({"root": run_dir.parent / "capture"}))


@pytest.mark.parametrize("path", ["orbit", "spiral"])
def test_time_runs_along_a_path_unless_told_otherwise(path: str, moving_run: Path, still_run: Path) -> None:
    job = job_of_run(moving_run, RenderJobOptions(path, 5))
    assert job.path.times == (0.0, 0.25, 0.5, 0.75, 1.0)
    assert len(job.notes) == 1
    assert "from 0 to 1" in job.notes[0]
    frozen = job_of_run(moving_run, RenderJobOptions(path, 5, times=(0.4,)))
    assert frozen.path.times == (0.4,) * 5
    assert torch.equal(frozen.path.cameras.cam_from_world, job.path.cameras.cam_from_world)
    together = job_of_run(moving_run, RenderJobOptions(path, 3, times=(1.0, 0.5, 0.0)))
    assert together.path.times == (1.0, 0.5, 0.0)
    assert (frozen.notes, together.notes) == ((), ())
    still = job_of_run(still_run, RenderJobOptions(path, 3))
    assert (still.path.times, still.notes) == (None, ())


def test_a_clip_is_followed_in_its_own_time(moving_run: Path, still_run: Path) -> None:
    job = job_of_run(moving_run, RenderJobOptions("along", 4))
    assert job.path.times is not None
    assert (job.path.times[0], job.path.times[-1]) == (min(TRAIN_TIMES), max(TRAIN_TIMES))
    assert job_of_run(still_run, RenderJobOptions("along", 4)).path.times is None


@pytest.mark.parametrize("path", ["orbit", "spiral", "along"])
def test_up_counts_for_runs(path: str, moving_run: Path) -> None:
    for name, up in (("y", [0.0, 1.0, 0.0]), ("-y", [0.0, -1.0, 0.0])):
        rights = job_of_run(moving_run, RenderJobOptions(path, 3, up=name)).path.cameras.cam_from_world[:, 0, :3]
        downs = job_of_run(moving_run, RenderJobOptions(path, 3, up=name)).path.cameras.cam_from_world[:, 1, :3]
        torch.testing.assert_close(rights @ torch.tensor(up), torch.zeros(3), atol=1e-6, rtol=0)
        assert (downs @ torch.tensor(up) < 0).all()


def test_times_of_a_still_run_are_accepted_with_a_note(still_run: Path) -> None:
    job = job_of_run(still_run, RenderJobOptions("orbit", 3, times=(0.0, 0.5, 1.0)))
    assert len(job.path) == 3
    assert "nothing moves" in job.notes[0]


def test_times_outside_are_clamped_with_one_warning(moving_run: Path) -> None:
    for options in (
        RenderJobOptions("orbit", 3, times=(-1.0, 0.5, 9.0)),
        RenderJobOptions(None, times=(-1.0, 0.5, 9.0)),
    ):
        job = job_of_run(moving_run, options)
        assert job.path.times == (0.0, 0.5, 1.0)
        assert len(job.path.warnings) == 1
        assert "clamped" in job.path.warnings[0]


def test_times_of_a_file_are_overridden(moving_run: Path, tmp_path: Path) -> None:
    cameras = cameras_for_paths(capture_of(moving_run), DataConfig(root=moving_run.parent / "capture"))
    file = tmp_path / "path.json"
    write_path(file, CameraPath(cameras, 12.0, (0.1, 0.2, 0.3, 0.4, 0.5)))
    own = job_of_run(moving_run, RenderJobOptions(str(file)))
    assert own.path.times == pytest.approx((0.1, 0.2, 0.3, 0.4, 0.5))
    assert (own.path.fps, own.notes) == (12.0, ())
    assert job_of_run(moving_run, RenderJobOptions(str(file), times=(0.7,))).path.times == (0.7,) * 5
    given = (0.0, 0.0, 1.0, 1.0, 0.5)
    assert job_of_run(moving_run, RenderJobOptions(str(file), times=given)).path.times == given
    with pytest.raises(DyngsError, match="5 cameras, but there are 3 times"):
        job_of_run(moving_run, RenderJobOptions(str(file), times=(0.0, 0.5, 1.0)))


def test_a_camera_that_stands_still(moving_run: Path) -> None:
    capture = capture_of(moving_run)
    wanted = ImageLoader(capture.splits["test"], DataConfig(root=capture.root))[1]
    job = job_of_run(moving_run, RenderJobOptions(None, times=(0.0, 0.5, 1.0), view="1"))
    assert job.path.times == (0.0, 0.5, 1.0)
    assert (job.path.cameras.width, job.path.cameras.height) == (16, 16)
    for i in range(3):
        torch.testing.assert_close(job.path.cameras.cam_from_world[i], wanted.cameras.cam_from_world[0])
        torch.testing.assert_close(job.path.cameras.intrinsics[i], wanted.cameras.intrinsics[0])
    assert job_of_run(moving_run, RenderJobOptions(None, view="1")).path.times == (TEST_TIMES[1],)
    assert job_of_run(moving_run, RenderJobOptions(None, split="train", view="1")).path.times == (TRAIN_TIMES[1],)
    small = job_of_run(moving_run, RenderJobOptions(None, times=(0.5,), size=(8, 4))).path.cameras
    assert (len(small), small.width, small.height) == (1, 8, 4)


def test_views_are_found_by_name_image_and_number(moving_run: Path) -> None:
    capture = capture_of(moving_run)
    test, train = capture.splits["test"], capture.splits["train"]
    assert view_to_show(capture) is test[0]
    assert view_to_show(capture, test[2].name) is test[2]
    assert view_to_show(capture, "r_002") is test[2]
    assert view_to_show(capture, "2") is test[2]
    assert view_to_show(capture, train[3].name) is train[3]  # no split given: names are looked for in all
    assert view_to_show(capture, "r_004") is train[4]
    assert view_to_show(capture, "4", "train") is train[4]
    assert view_to_show(capture.replace(splits={"train": train, "test": ()})) is train[0]
    for name, split in (("9", None), ("r_9", None), ("-1", None), (train[0].name, "test")):
        with pytest.raises(DyngsError, match=rf"no view '{name}'; the split test has 3 views: .*\(0\) to .*\(2\)"):
            view_to_show(capture, name, split)
    with pytest.raises(DyngsError, match="'val' has no views"):
        view_to_show(capture, None, "val")
