"""Predictions as run folders: other commands accept them, and wrong inputs raise errors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from tiny_people import NET, TINY, people

from dyngs.api.predict import Prediction, network_config, predict
from dyngs.api.train import train
from dyngs.config import Config
from dyngs.config.io import load_resolved, save_config
from dyngs.core.errors import DyngsError
from dyngs.evaluate.report import evaluate_run
from dyngs.human.avatar.scene import HumanScene
from dyngs.runs.checkpoint import load_run


@dataclass(frozen=True)
class Made:
    """A network of two steps, the capture of another person, and the prediction of that."""

    network: Path
    capture: Path
    prediction: Prediction


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("predicted")
    people(folder / "people", (1,))
    values = {
        "data": {"root": folder / "people"},
        "model": NET,
        "train": {"steps": 2},
        "run": {"dir": folder / "net"},
    }
    network = train(Config.model_validate(values))
    capture = people(folder / "others", (5,)) / "p5"
    return Made(network, capture, predict(network, capture, folder / "run", 3, steps=1))


def test_a_prediction_is_a_run_of_a_person(made: Made) -> None:
    """Which is drawn, measured on both splits, and knows its images."""
    run = load_run(made.prediction.run_dir)
    assert isinstance(run.scene, HumanScene)
    assert (run.config.model.kind, run.step, run.config.data.root) == ("human", 0, made.capture)
    assert len(run.scene) == made.prediction.num_gaussians > 500
    assert bool((run.scene.gaussians.opacities >= 0.02).all())
    assert len(made.prediction.views) == 3
    for split in ("test", "pose"):
        report = evaluate_run(made.prediction.run_dir, split, threads=1)
        assert report.psnr_person is not None
        assert 6 < report.psnr_person < report.psnr, "32 pixels and a network of two steps"


def test_the_same_images_give_the_same_bytes(made: Made, tmp_path: Path) -> None:
    again = predict(
        made.network, made.capture, tmp_path / "again", tuple(made.prediction.views), steps=1
    )
    assert again.views == made.prediction.views
    first, second = (
        load_run(run.run_dir).scene.gaussians.tensors().values() for run in (made.prediction, again)
    )
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_a_prediction_can_be_refined(made: Made, tmp_path: Path) -> None:
    out = predict(made.network, made.capture, tmp_path / "run", 2, steps=0).run_dir
    config = load_resolved(out)
    short = config.model_copy(update={"train": config.train.model_copy(update={"steps": 3})})
    save_config(short, out / "config.yaml")
    before = load_run(out)
    after = load_run(train(short.model_copy(update={"run": config.run}), resume_from=out))
    assert (before.step, after.step) == (0, 3)
    assert not torch.equal(before.scene.gaussians.means, after.scene.gaussians.means)


def test_wrong_inputs_are_refused(made: Made, tmp_path: Path) -> None:
    run = made.prediction.run_dir
    with pytest.raises(DyngsError, match="exists already"):
        predict(made.network, made.capture, run, 3)
    with pytest.raises(DyngsError, match="kind=human; a prediction needs the run of a network"):
        network_config(run)
    with pytest.raises(DyngsError, match="not a run folder"):
        predict(tmp_path, made.capture, tmp_path / "out", 3)
    with pytest.raises(DyngsError, match="no training view is named 'x'"):
        predict(made.network, made.capture, tmp_path / "out", ("x",))
    for count in (0, TINY.num_cameras + 1):
        with pytest.raises(DyngsError, match=f"cannot choose {count} of its 8"):
            predict(made.network, made.capture, tmp_path / "out", count)
    with pytest.raises(DyngsError, match="no such folder"):
        predict(made.network, tmp_path / "nowhere", tmp_path / "out", 3)
    with pytest.raises(DyngsError, match="-1 steps"):
        predict(made.network, made.capture, tmp_path / "out", 3, steps=-1)
    assert not (tmp_path / "out").exists()
    with pytest.raises(
        DyngsError, match="a network, not a scene; predict a scene with `dyngs predict"
    ):
        load_run(made.network)
