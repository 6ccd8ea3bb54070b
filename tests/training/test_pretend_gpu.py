"""Training with the scene on a separate device: no CPU tensor enters it, and the result is the
same."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import pytest
import torch
from pretend_gpu import GPU, OnGpu, pretend_gpu
from small_fields import NERF, NGP

from dyngs.api.train import train
from dyngs.config import Config
from dyngs.config.io import load_config
from dyngs.evaluate.report import EvalReport, evaluate_run
from dyngs.export.images import write_split_images
from dyngs.runs.checkpoint import SCENE_FILE, checkpoint_paths
from dyngs.runs.folder import EXPORT_FOLDER
from dyngs.runs.opened import open_run
from dyngs.training.new_trainer import build_trainer
from dyngs.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("one_thread")


def config_of(kind: str, root: Path, *more: str) -> Config:
    return load_config(Path(kind), [f"data.root={root}", *more])


def trained(config: Config, monkeypatch: pytest.MonkeyPatch, device: torch.device) -> Trainer:
    """The trainer after all steps."""
    monkeypatch.setattr("dyngs.training.new_trainer.select_device", lambda _: device)
    trainer = build_trainer(config)
    while trainer.done < config.train.steps:
        trainer.step()
    return trainer


STATIC = ("train.steps=12", "init.kind=random", "init.num_random=100")
DYNAMIC = (
    "train.steps=16",
    "model.pilot_runs=false",
    "model.num_random_moving=100",
    "init.kind=random",
    "init.num_random=300",
)
CASES = {
    "growing": (
        "static",
        "still",
        (*STATIC, "strategy.every=5", "strategy.start=1", "strategy.grad_threshold=1e-7"),
    ),
    "mcmc": (
        "static_mcmc",
        "still",
        (*STATIC, "strategy.every=5", "strategy.start=1", "strategy.prune_opacity=0.09"),
    ),
    "mip": (
        "mip",
        "still",
        (*STATIC, "strategy.every=5", "strategy.start=1", "strategy.grad_threshold=1e-7"),
    ),
    "network": ("static", "still", (*STATIC, "colour.kind=network")),
    # has views enough to hold some out
    "auto colour": ("static", "moving", (*STATIC, "colour.kind=auto")),
    "corrections": (
        "static",
        "still",
        (*STATIC, "train.exposure=always", "camera.refine=always", "train.robust=always"),
    ),
    "nodes": ("dynamic", "moving", DYNAMIC),
    "hexplane": (
        "dynamic",
        "moving",
        (*DYNAMIC, "model.deform.kind=hexplane", "model.deform.resolution=16"),
    ),
    "4D Gaussians": (
        "dynamic",
        "moving",
        (*DYNAMIC, "model.deform.kind=gaussians_4d", "model.deform.predictor_width=8"),
    ),
    "human": ("human", "person", ("train.steps=8", "model.resolution=24", "model.fit=false")),
    "ngp": ("ngp", "still", (*NGP, "train.steps=9")),
    "ngp in time": ("ngp", "moving", (*NGP, "train.steps=6", "model.time=true")),
    "nerf": ("nerf", "still", (*NERF, "train.steps=6")),
}
"""Preset, capture and overrides by name."""


@pytest.mark.parametrize("name", CASES)
def test_it_learns_there_what_it_learns_on_the_cpu(
    name: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same kernels compute, so that not a bit may differ; an operator given tensors of both
    devices raises."""
    kind, capture, more = CASES[name]
    config = config_of(kind, request.getfixturevalue(capture), *more)
    for name, steps in (("EVERY", 2), ("WARM_UP", 4)):
        # the second time, at step 6, only some cells are looked at
        monkeypatch.setattr(f"dyngs.baselines.fields.ngp.{name}", steps)
    expected = trained(config, monkeypatch, torch.device("cpu")).checkpoint().tensors
    with pretend_gpu():
        trainer = trained(config, monkeypatch, GPU)
        assert all(isinstance(x, OnGpu) for x in trainer.model.leaves)
        found = trainer.checkpoint().tensors
        assert name not in ("growing", "mcmc", "mip") or len(trainer.model.scene) != 100, (
            "the set was to change"
        )
    assert found.keys() == expected.keys()
    assert [key for key, x in expected.items() if not torch.equal(found[key], x)] == []


def test_a_run_goes_on_there_from_a_checkpoint(
    still: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = config_of("static", still, *STATIC, "camera.refine=always", "train.exposure=always")
    monkeypatch.setattr("dyngs.training.new_trainer.select_device", lambda _: torch.device("cpu"))
    begun = build_trainer(config)
    expected = build_trainer(config)
    for _ in range(10):
        begun.step()
    stored = begun.checkpoint()
    expected.restore(stored)
    with pretend_gpu():
        monkeypatch.setattr("dyngs.training.new_trainer.select_device", lambda _: GPU)
        resumed = build_trainer(config, restored=True)
        resumed.restore(stored)
        for _ in range(10):
            expected.step()
            resumed.step()
        found = resumed.checkpoint().tensors
    assert [
        key for key, x in expected.checkpoint().tensors.items() if not torch.equal(found[key], x)
    ] == []


SCORED = {
    "static": ("test", True, ()),
    "nodes": ("test", False, ("train.steps=25",)),
    "human": ("pose", True, ()),
    "corrections": ("train", False, ()),
    "ngp": ("test", False, ()),
}
"""Split, whether poses are refined, and overrides by the name of a case."""


@pytest.mark.parametrize("name", SCORED)
def test_views_are_drawn_and_scored_there_alike(
    name: str, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, (split, refined, others) = tmp_path / "run", SCORED[name]
    for few in (
        "human.avatar.pose_fit.UPDATES_PER_WINDOW",
        "human.avatar.pose_fit.MAX_WINDOWS",
        "training.corrections.camera_refinement.FIT_UPDATES",
    ):
        monkeypatch.setattr(f"dyngs.{few}", 2)
    kind, capture, more = CASES[name] if name != "static" else ("static", "still", STATIC)
    train(config_of(kind, request.getfixturevalue(capture), *more, *others, f"run.dir={folder}"))
    expected = evaluate_run(folder, split, refine_poses=refined)
    images = write_split_images(open_run(folder), split, tmp_path / "cpu")
    monkeypatch.setattr("dyngs.evaluate.report.select_device", lambda _: GPU)
    with pretend_gpu():
        found = evaluate_run(folder, split, refine_poses=refined)
        there = write_split_images(open_run(folder), split, tmp_path / "GPU", device=GPU)
    assert without_times(found) == without_times(expected)
    assert [x.read_bytes() for x in there] == [x.read_bytes() for x in images]


def without_times(report: EvalReport) -> dict[str, object]:
    """The fields of a report, and of its parts, but for how long things took."""

    def kept(x: object) -> object:
        if isinstance(x, dict):
            times = ("fps", "deform_fraction", "render_seconds", "deform_seconds", "seconds_train")
            return {key: kept(value) for key, value in x.items() if key not in times}
        return [kept(each) for each in x] if isinstance(x, (list, tuple)) else x

    found = kept(asdict(report))
    assert isinstance(found, dict)
    return found


def test_with_limits_and_pruning_it_ends_with_the_same_bytes(
    still: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(name: str) -> list[bytes]:
        limits = (
            "budget.max_gaussians=80",
            "budget.max_mb=0.02",
            "prune.fraction=0.3",
            "prune.steps=10",
        )
        folder = train(
            config_of(
                "static", still, *STATIC, *limits, f"run.dir={tmp_path / name}", "run.threads=1"
            )
        )
        return [
            checkpoint_paths(folder)[-1].read_bytes(),
            (folder / EXPORT_FOLDER / SCENE_FILE).read_bytes(),
        ]

    expected = run("cpu")
    monkeypatch.setattr("dyngs.training.new_trainer.select_device", lambda _: GPU)
    with pretend_gpu():
        assert run("GPU") == expected
