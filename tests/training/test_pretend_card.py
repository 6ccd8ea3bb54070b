"""Training where the scene lies on a device of its own: nothing of the CPU gets into it, and it learns the same."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from pretend_card import CARD, OnCard, pretend_card

from dyngs.api.train import train
from dyngs.build import assemble
from dyngs.config import Config
from dyngs.config.io import load_config
from dyngs.evaluate.report import evaluate_run
from dyngs.output.image_files import write_split_images
from dyngs.runs.checkpoint import checkpoint_paths
from dyngs.state import tensors_of
from dyngs.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("one_thread")


def config_of(kind: str, root: Path, *more: str) -> Config:
    return load_config(Path(kind), [f"data.root={root}", *more])


def trained(config: Config, monkeypatch: pytest.MonkeyPatch, device: torch.device) -> Trainer:
    """The trainer after all steps."""
    monkeypatch.setattr("dyngs.build.device_for", lambda _: device)
    trainer = assemble(config)
    while trainer.done < config.train.steps:
        trainer.step()
    return trainer


STATIC = ("train.steps=20", "init.kind=random", "init.num_random=100")
DYNAMIC = ("train.steps=24", "model.num_random_moving=100", "init.kind=random", "init.num_random=300")
CASES = {
    "growing": ("static", "still", (*STATIC, "strategy.every=5", "strategy.start=1", "strategy.grad_threshold=1e-7")),
    "mcmc": ("static_mcmc", "still", (*STATIC, "strategy.every=5", "strategy.start=1", "strategy.min_opacity=0.09")),
    "mip": ("mip", "still", (*STATIC, "strategy.every=5", "strategy.start=1", "strategy.grad_threshold=1e-7")),
    "network": ("static", "still", (*STATIC, "colour.kind=network")),
    "auto colour": ("static", "still", (*STATIC, "colour.kind=auto")),
    "exposure": ("static", "still", (*STATIC, "train.exposure=always")),
    "cameras": ("static", "still", (*STATIC, "camera.refine=always")),
    "robust": ("static", "still", (*STATIC, "train.robust=always")),
    "nodes": ("dynamic", "moving", DYNAMIC),
    "hexplane": ("dynamic", "moving", (*DYNAMIC, "model.deform.kind=hexplane", "model.deform.resolution=16")),
    "human": ("human", "person", ("train.steps=8", "model.resolution=24")),
}
"""Preset, capture and overrides by name."""


@pytest.mark.parametrize("name", CASES)
def test_it_learns_there_what_it_learns_on_the_cpu(
    name: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same kernels compute, so that not a bit may differ; an operator given tensors of both devices raises."""
    kind, capture, more = CASES[name]
    config = config_of(kind, request.getfixturevalue(capture), *more)
    expected = tensors_of(trained(config, monkeypatch, torch.device("cpu")).state())
    with pretend_card():
        trainer = trained(config, monkeypatch, CARD)
        assert all(isinstance(x, OnCard) for x in trainer.scene.gaussians.tensors().values())
        found = trainer.checkpoint().tensors
        assert len(trainer.scene) != 100 or name not in ("growing", "mcmc", "mip"), "the set was to change"
    assert found.keys() == expected.keys()
    assert [key for key, x in expected.items() if not torch.equal(found[key], x)] == []


def test_a_network_without_a_kernel_is_computed_by_torch(still: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_of("static", still, *STATIC, "colour.kind=network")
    expected = trained(config, monkeypatch, torch.device("cpu")).colours.network
    assert expected is not None
    with pretend_card(without=("perceptron", "perceptron_backward")):
        network = trained(config, monkeypatch, CARD).colours.network
        assert network is not None
        found = network.layers[0].weight.detach().cpu()
    torch.testing.assert_close(found, expected.layers[0].weight, rtol=1e-3, atol=1e-4)


def test_a_run_goes_on_there_from_a_checkpoint(still: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_of("static", still, *STATIC, "camera.refine=always", "train.exposure=always")
    monkeypatch.setattr("dyngs.build.device_for", lambda _: torch.device("cpu"))
    begun, expected = assemble(config), assemble(config)
    for _ in range(10):
        begun.step()
    stored = begun.checkpoint()
    expected.restore(stored)
    with pretend_card():
        monkeypatch.setattr("dyngs.build.device_for", lambda _: CARD)
        resumed = assemble(config, restored=True)
        resumed.restore(stored)
        for _ in range(10):
            expected.step()
            resumed.step()
        found = resumed.checkpoint().tensors
    assert [key for key, x in tensors_of(expected.state()).items() if not torch.equal(found[key], x)] == []


def test_how_often_the_host_waits_in_a_step(still: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every wait costs a card some ten microseconds of idleness; docs/gpu.md has the numbers."""
    config = config_of("static", still, *STATIC, "strategy.kind=fixed")
    with pretend_card() as card:
        monkeypatch.setattr("dyngs.build.device_for", lambda _: CARD)
        trainer = assemble(config)
        for _ in range(3):
            trainer.step()
        card.waits.clear()
        for _ in range(10):
            trainer.step()
        waits = {name: count / 10 for name, count in card.waits.items()}
    assert waits == {"item": 7, "to the card": 9}


def test_views_are_drawn_and_scored_there_alike(still: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "run"
    train(config_of("static", still, *STATIC, f"run.dir={folder}"))
    expected = evaluate_run(folder)
    pictures = write_split_images(folder, "test", tmp_path / "cpu")
    monkeypatch.setattr("dyngs.evaluate.report.device_for", lambda _: CARD)
    with pretend_card():
        found = evaluate_run(folder)
        there = write_split_images(folder, "test", tmp_path / "card", device=CARD)
    assert (found.psnr, found.ssim) == (expected.psnr, expected.ssim)
    assert [x.read_bytes() for x in there] == [x.read_bytes() for x in pictures]


def test_with_limits_and_pruning_it_ends_with_the_same_bytes(
    still: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(name: str) -> list[bytes]:
        limits = ("budget.max_gaussians=80", "prune.share=0.3", "prune.steps=10")
        folder = train(config_of("static", still, *STATIC, *limits, f"run.dir={tmp_path / name}", "run.threads=1"))
        return [checkpoint_paths(folder)[-1].read_bytes()]

    expected = run("cpu")
    monkeypatch.setattr("dyngs.build.device_for", lambda _: CARD)
    with pretend_card():
        assert run("card") == expected
