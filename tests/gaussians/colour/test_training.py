"""What is learned of colours beside harmonics, its rates, when harmonics are measured, and the
entropy of opacities."""

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
    ShColour,
    StaticModel,
    TrainConfig,
)
from dyngs.core.state import tensors_of
from dyngs.data.synthetic.captures import StillOptions, write_still_capture
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.colour.network import network_of
from dyngs.gaussians.colour.training import (
    AutoTraining,
    ColourTraining,
    NetworkTraining,
    TrainingLooks,
    opacity_entropy,
    rate_factor,
)
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.gaussians.restored import restored_scene
from dyngs.training.new_trainer import GaussianTrainer, assemble


def gaussians() -> Gaussians:
    drawn = random_scene(n=30, degree=0).gaussians
    return Gaussians(**{name: x.float() for name, x in drawn.tensors().items()})


def colours(seed: int = 0, **options: object) -> NetworkTraining:
    box = torch.tensor([[0.0] * 3, [2.0] * 3])
    generator = torch.Generator().manual_seed(seed)
    return NetworkTraining(
        NetworkColour.model_validate(options), 60, box, generator, sees_time=True
    )


def stored(learner: NetworkTraining) -> dict[str, Tensor]:
    """What a checkpoint has of colours: of the scene, and of its training."""
    return {
        name: x.clone() for name, x in tensors_of(learner.network.state() | learner.state()).items()
    }


def test_plain_colours_do_nothing() -> None:
    plain = ColourTraining(ShColour())
    assert plain.network is None
    assert plain.penalties(gaussians()) == {}
    assert plain.optimize(1) == 0
    assert plain.state() == {}
    assert plain.frozen_rest() is None
    assert not plain.holds_out(5, 1)


def test_an_untrained_network_shows_the_base_colours() -> None:
    camera = random_scene(views=1).to(torch.float32).cameras
    drawn = [
        render(gaussians(), camera, shader=s).rgb for s in (None, colours().network.shader(0.4))
    ]
    # base + 0 in another order of float32 sums
    torch.testing.assert_close(drawn[0], drawn[1], rtol=0, atol=1e-6)


def test_it_learns_what_depends_on_the_view() -> None:
    """Base colours fixed: only the network can tell the two views apart."""
    cameras = random_scene(views=2).to(torch.float32).cameras
    shown = torch.ones(2, 30, 2, dtype=torch.int32)
    target = torch.tensor([0.2, 0.8])[:, None, None]
    learner = colours(lr=0.1)
    drawn = gaussians()
    losses = []
    for step in range(1, 61):
        error = (learner.network.shader(0.5)(drawn, cameras, shown) - target).square().mean()
        error.backward()
        losses.append(float(error.detach()))
        assert learner.optimize(step) == 0
    assert losses[-1] < 0.1 * losses[0]


def test_the_rate_warms_up_and_falls_by_thirds() -> None:
    factors = [rate_factor(step, 1200) for step in range(1, 1201)]
    assert factors[49] == pytest.approx(0.5)
    assert factors[99] == factors[199] == 1
    assert factors[200] == pytest.approx(1 / 3)
    assert factors[600] == pytest.approx(1 / 9)
    assert factors[1199] == pytest.approx(1 / 27)


def test_a_bad_gradient_is_left_out_and_counted() -> None:
    learner = colours()
    before = stored(learner)
    learner.network.layers[-1].bias.grad = torch.tensor([1.0, float("nan"), 1.0])
    assert learner.optimize(1) == 1
    after = stored(learner)
    assert (after["bias2"] != before["bias2"]).tolist() == [True, False, True]
    assert all(x.isfinite().all() for x in after.values() if x.is_floating_point())


def test_state_goes_round_and_training_goes_on_alike() -> None:
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
    found = network_of(stored(whole))
    assert found is not None
    assert torch.equal(found.layers[1].weight, whole.network.layers[1].weight)


def test_every_eighth_view_is_held_out_until_it_is_measured() -> None:
    colours = AutoTraining(AutoColour(), 100, 20)
    assert [i for i in range(20) if colours.holds_out(i, 60)] == [5, 13]
    assert not any(colours.holds_out(i, 61) for i in range(20))
    assert measured_steps(colours) == [60]
    few = AutoTraining(AutoColour(), 100, 5)
    assert not few.held_out
    assert measured_steps(few) == [], "too few views to spare one"


def measured_steps(colours: AutoTraining) -> list[int]:
    """Steps of 100 after which views are looked at; here there are none to look at."""
    looked: list[int] = []
    for step in range(101):

        def looks(step: int = step) -> TrainingLooks:
            looked.append(step)
            return TrainingLooks((), lambda _: iter(()), RenderOptions(), torch.zeros(3))

        found = colours.measured(step, looks)
        assert (found is None) == (step not in looked)
        assert found is None or (found.rows is None and "all harmonics stay" in found.text)
    return looked


def test_the_frozen_follow_the_set_and_go_round() -> None:
    colours = AutoTraining(AutoColour(), 100, 20)
    assert colours.frozen_rest() is None
    colours.freeze(torch.tensor([True, False, True]))
    colours.follow(TopologyEdit(torch.tensor([1, 2, 2]), torch.tensor([False, False, True])))
    assert colours.frozen_rest() is not None
    other = AutoTraining(AutoColour(), 100, 20)
    other.restore(tensors_of(colours.state()), 3)
    frozen = other.frozen_rest()
    assert frozen is not None
    assert frozen.tolist() == [False, True, True]
    with pytest.raises(ValueError, match="frozen"):
        other.restore(tensors_of(colours.state()), 4)
    colours.freeze(torch.ones(3, dtype=torch.bool))
    assert colours.frozen_rest() is None, (
        "where no harmonics are stored none need to be kept at zero"
    )


@given(st.floats(-1e4, 1e4))
def test_the_entropy_and_its_gradient_are_finite_and_right(logit: float) -> None:
    x = torch.tensor([logit], dtype=torch.float64, requires_grad=True)
    value = opacity_entropy(x)
    value.backward()
    o = torch.sigmoid(x.detach())
    log = torch.nn.functional.logsigmoid(x.detach())
    assert 0 <= float(value.detach()) <= 1 / torch.e + 1e-12
    assert x.grad is not None
    torch.testing.assert_close(x.grad, -(log + 1) * o * torch.sigmoid(-x.detach()))


def test_the_entropy_pushes_away_from_one_over_e() -> None:
    logits = torch.tensor([0.2, 0.3, 0.45, 0.6]).logit().requires_grad_()
    opacity_entropy(logits).backward()
    assert logits.grad is not None
    assert (logits.grad > 0).tolist() == [True, True, False, False], (
        "a step down the gradient makes the faint fainter"
    )


def test_the_entropy_is_weighted_and_of_nothing_zero() -> None:
    some = gaussians()
    (term,) = ColourTraining(ShColour(opacity_entropy=0.5)).penalties(some).values()
    assert float(term) == pytest.approx(0.5 * float(opacity_entropy(some.logit_opacities)))
    assert float(opacity_entropy(torch.zeros(0))) == 0


MEASURED_AFTER = 24


COLOURS = {
    "network": NetworkColour(width=8, depth=1, opacity_entropy=1e-3),
    "none pays": AutoColour(tolerance=300.0),
    "some pay": AutoColour(tolerance=0.0),
}


@pytest.fixture(scope="module")
def seven_views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_still_capture(folder, StillOptions(size=16, num_train=7, num_test=1, samples=1))
    return folder


def _coloured(
    capture: Path, colour: NetworkColour | AutoColour, strategy: DefaultStrategy | None = None
) -> GaussianTrainer:
    return assemble(
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
def test_every_kind_of_colour_learns_and_goes_on_exactly(seven_views: Path, name: str) -> None:
    """From a checkpoint before the harmonics are measured, and from one after."""
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
def test_harmonics_that_do_not_pay_are_dropped(seven_views: Path, name: str) -> None:
    """For good: they stay zero while the set changes; the view that tells is not trained on
    before."""
    busy = DefaultStrategy(
        start=1, stop=30_000, every=3, grad_threshold=1e-6, reset_every=1_000_000
    )
    trainer = _coloured(seven_views, COLOURS[name], busy)
    seen = set()
    findings = {}
    counts = set()
    for step in range(1, 41):
        report = trainer.step()
        counts.add(len(trainer.model.scene.gaussians))
        if report.finding is not None:
            findings[step] = report.finding
            dropped = trainer.model.colours.frozen_rest()
        if step <= MEASURED_AFTER:
            seen.add(report.image.name)
    assert len(seen) == 6
    assert list(findings) == [MEASURED_AFTER]
    assert len(counts) > 4
    sh = trainer.model.scene.gaussians.sh
    frozen = trainer.model.colours.frozen_rest()
    if name == "none pays":
        assert "does not pay" in findings[MEASURED_AFTER]
        assert sh.shape[1] == 1
    else:
        assert dropped is not None
        assert frozen is not None
        assert 0 < int(frozen.sum()) < len(frozen) == len(sh)
        assert torch.equal((sh[:, 1:] == 0).flatten(1).all(1), frozen)


def test_a_network_stores_no_harmonics(seven_views: Path, tmp_path: Path) -> None:
    """And what was trained is drawn with it."""
    trainer = _coloured(seven_views, COLOURS["network"])
    for _ in range(30):
        trainer.step()
    assert trainer.model.scene.gaussians.sh_degree == 0
    scene = restored_scene(trainer.checkpoint(), trainer.config.model)
    network = trainer.model.colours.network
    assert network is not None
    camera = trainer.images[0].cameras
    gaussians = trainer.model.scene.gaussians.detach()
    shader = network.shader(None, None)
    drawn = scene.render(camera, options=RenderOptions(), background=torch.zeros(3)).rgb
    assert torch.equal(drawn, render(gaussians, camera, shader=shader).rgb.detach())
    assert not torch.equal(drawn, render(gaussians, camera).rgb)
    assert scene.colour is not None
    assert scene.num_colour_values == 3 * len(gaussians) + scene.colour.num_values
