"""Training of colours beyond SH: learning rates, pruning of SH, and opacity entropy."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scenes import random_scene
from torch import Tensor

from dyngs.config import (
    AutoColour,
    Config,
    DataConfig,
    DefaultStrategy,
    NetworkColour,
    RandomInit,
    RunConfig,
    TrainConfig,
)
from dyngs.core.state import strip_roles
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.colour.network import restore_colour_network
from dyngs.gaussians.colour.training import (
    AutoTraining,
    NetworkTraining,
    opacity_entropy,
    rate_factor,
)
from dyngs.models.static_section import StaticModel
from dyngs.training.new_trainer import GaussianTrainer, build_trainer


def gaussians() -> Gaussians:
    drawn = random_scene(n=30, degree=0).gaussians
    return Gaussians(**{name: x.float() for name, x in drawn.tensors().items()})


def colours(seed: int = 0, **options: object) -> NetworkTraining:
    box = torch.tensor([[0.0] * 3, [2.0] * 3])
    generator = torch.Generator().manual_seed(seed)
    return NetworkTraining(
        NetworkColour.model_validate(options), 60, box, generator, uses_time=True
    )


def stored(learner: NetworkTraining) -> dict[str, Tensor]:
    """Colour tensors in a checkpoint, of the scene and of its optimizer."""
    return {
        name: x.clone()
        for name, x in strip_roles(learner.network.state() | learner.state()).items()
    }


def test_the_rate_warms_up_and_falls_by_thirds() -> None:
    factors = [rate_factor(step, 1200) for step in range(1, 1201)]
    assert factors[49] == pytest.approx(0.5)
    assert factors[99] == factors[199] == 1
    assert factors[200] == pytest.approx(1 / 3)
    assert factors[600] == pytest.approx(1 / 9)
    assert factors[1199] == pytest.approx(1 / 27)


def test_resume_equals_uninterrupted_training() -> None:
    cameras = random_scene(views=1).to(torch.float32).cameras
    shown = torch.ones(1, 30, 2, dtype=torch.int32)

    def train(learner: NetworkTraining, first: int, last: int) -> None:
        for step in range(first, last + 1):
            (
                learner.network.shader(0.1)(gaussians(), cameras, shown) - 0.3
            ).square().mean().backward()
            learner.optimize(step)

    whole = colours()
    resumed = colours(seed=5)
    train(whole, 1, 5)
    resumed.restore(stored(whole), 30)
    train(whole, 6, 10)
    train(resumed, 6, 10)
    for name, x in stored(whole).items():
        assert torch.equal(x, stored(resumed)[name]), name
    found = restore_colour_network(stored(whole))
    assert found is not None
    assert torch.equal(found.layers[1].weight, whole.network.layers[1].weight)


def test_frozen_masks_follow_edits_and_are_restored() -> None:
    colours = AutoTraining(AutoColour(), 100, 20)
    assert colours.frozen_harmonics is None
    colours.freeze(torch.tensor([True, False, True]))
    colours.apply_edit(TopologyEdit(torch.tensor([1, 2, 2]), torch.tensor([False, False, True])))
    assert colours.frozen_harmonics is not None
    other = AutoTraining(AutoColour(), 100, 20)
    other.restore(strip_roles(colours.state()), 3)
    frozen = other.frozen_harmonics
    assert frozen is not None
    assert frozen.tolist() == [False, True, True]
    with pytest.raises(ValueError, match="frozen"):
        other.restore(strip_roles(colours.state()), 4)
    colours.freeze(torch.ones(3, dtype=torch.bool))
    assert colours.frozen_harmonics is None, (
        "where no harmonics are stored none need to be kept at zero"
    )


@given(st.floats(-1e4, 1e4))
def test_opacity_entropy_and_its_gradient(logit: float) -> None:
    x = torch.tensor([logit], dtype=torch.float64, requires_grad=True)
    value = opacity_entropy(x)
    value.backward()
    o = torch.sigmoid(x.detach())
    log = torch.nn.functional.logsigmoid(x.detach())
    assert 0 <= float(value.detach()) <= 1 / torch.e + 1e-12
    assert x.grad is not None
    torch.testing.assert_close(x.grad, -(log + 1) * o * torch.sigmoid(-x.detach()))


MEASURED_AFTER = 24


COLOURS = {
    "network": NetworkColour(width=8, depth=1, opacity_entropy=1e-3),
    "network without normals": NetworkColour(width=8, depth=1, normals=False),
    "none pays": AutoColour(tolerance=300.0),
    "some pay": AutoColour(tolerance=0.0),
}


@pytest.fixture(scope="module")
def seven_views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_static_capture(folder, StaticOptions(size=16, num_train=7, num_test=1, samples=1))
    return folder


def _coloured(
    capture: Path, colour: NetworkColour | AutoColour, strategy: DefaultStrategy | None = None
) -> GaussianTrainer:
    return build_trainer(
        Config(
            data=DataConfig(root=capture),
            model=StaticModel(sh_degree=1),
            init=RandomInit(num_random=50, half_extent=1.3),
            colour=colour,
            strategy=strategy or DefaultStrategy(),
            train=TrainConfig(steps=40, sh_every=1),
            run=RunConfig(threads=1),
        )
    )


@pytest.mark.parametrize("name", COLOURS)
def test_every_colour_model_trains_and_resumes_exactly(seven_views: Path, name: str) -> None:
    """Resumed from a checkpoint before SH pruning, and from one after it."""
    whole = _coloured(seven_views, COLOURS[name])
    losses = []
    for step in range(1, 41):
        if step in (20, 31):
            resumed = _coloured(seven_views, COLOURS[name])
            resumed.restore(whole.checkpoint())
        losses.append(whole.step().loss)
        if step > 20:
            resumed.step()
    assert sum(losses[-7:]) < sum(losses[:7])
    wanted = whole.checkpoint().tensors
    found = resumed.checkpoint().tensors
    assert wanted.keys() == found.keys()
    assert all(torch.equal(x, found[key]) for key, x in wanted.items())


@pytest.mark.parametrize("name", ["none pays", "some pay"])
def test_harmonics_without_gain_are_dropped(seven_views: Path, name: str) -> None:
    """Dropped SH stay zero after later edits. The validation view is excluded from training
    before.
    """
    busy = DefaultStrategy(
        start=1, stop=30_000, every=3, grad_threshold=1e-6, reset_every=1_000_000
    )
    trainer = _coloured(seven_views, COLOURS[name], busy)
    seen = set()
    messages = {}
    counts = set()
    for step in range(1, 41):
        report = trainer.step()
        counts.add(len(trainer.model.scene.gaussians))
        if report.message is not None:
            messages[step] = report.message
            dropped = trainer.model.colours.frozen_harmonics
        if step <= MEASURED_AFTER:
            seen.add(report.image.name)
    assert len(seen) == 6
    assert list(messages) == [MEASURED_AFTER]
    assert len(counts) > 4
    sh = trainer.model.scene.gaussians.sh
    frozen = trainer.model.colours.frozen_harmonics
    if name == "none pays":
        assert "view-dependent colour removed" in messages[MEASURED_AFTER]
        assert sh.shape[1] == 1
    else:
        assert dropped is not None
        assert frozen is not None
        assert 0 < int(frozen.sum()) < len(frozen) == len(sh)
        assert torch.equal((sh[:, 1:] == 0).flatten(1).all(1), frozen)
