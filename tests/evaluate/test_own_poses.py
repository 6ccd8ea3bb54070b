"""Scores from poses refined on the images themselves, and training images with the cameras that training found."""

from __future__ import annotations

from pathlib import Path

import pytest

import dyngs
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError
from dyngs.evaluate.own_poses import images_of_split
from dyngs.evaluate.report import evaluate_run
from dyngs.runs.checkpoint import latest_checkpoint, load_run


@pytest.fixture(scope="module", params=["always", "never"])
def run(request: pytest.FixtureRequest, still: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("runs") / request.param
    keys = [f"data.root={still}", f"run.dir={folder}", "train.steps=30", "init.num_random=60", "run.threads=1"]
    return dyngs.train(dyngs.load_config("static", [*keys, f"camera.refine={request.param}"])), request.param


def test_the_second_figure_is_there_where_cameras_were_refined_or_it_is_asked_for(run: tuple[Path, str]) -> None:
    folder, refine = run
    report, asked = evaluate_run(folder), evaluate_run(folder, refine_poses=True)
    assert (report.psnr_own_poses is not None) == (refine == "always")
    assert asked.psnr_own_poses is not None
    assert asked.psnr_own_poses > asked.psnr - 0.2  # its loss is not PSNR
    assert asked.psnr == report.psnr
    assert asked.own_poses is None, "nobody is in the images"
    assert evaluate_run(folder, "train").psnr_own_poses is None
    with pytest.raises(DyngsError, match="--refine is for images that were not trained on"):
        evaluate_run(folder, "train", refine_poses=True)


def test_training_images_have_the_refined_cameras(run: tuple[Path, str]) -> None:
    folder, refine = run
    loaded = load_run(folder)
    capture = read_capture(loaded.config.data)
    views = capture.splits["train"]
    refined = images_of_split(capture, views, folder, loaded)[0].cameras
    given = ImageLoader(views, loaded.config.data)[0].cameras
    moved = float((refined.cam_from_world - given.cam_from_world).abs().max())
    assert (moved > 0) == (refine == "always")
    if refine == "always":
        assert bool(latest_checkpoint(folder).part("cameras")["poses"].any())
