"""Schedules: the published values at 30,000 steps, and scaled ones at other lengths."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.config import (
    Config,
    DataConfig,
    DefaultStrategy,
    McmcStrategy,
    OptimConfig,
    SceneModel,
    TrainConfig,
)
from dyngs.config.io import load_config, packaged_preset
from dyngs.deform.keys import DynamicModel, FreeField
from dyngs.deform.schedule import deform_schedule
from dyngs.gaussians.schedule import (
    GROWTH,
    MAX_GROWTH,
    MIN_RESET_GAP,
    RateSchedule,
    active_sh_degree,
    densify_schedule,
    filter_steps,
    grad_threshold,
    growth_per_change,
    means_rate,
    rate_factors,
)
from dyngs.human.keys import HumanModel
from dyngs.models.schedule import image_divisor
from dyngs.models.static_section import StaticModel


def test_published_schedule_at_30000_steps() -> None:
    schedule = densify_schedule(DefaultStrategy(), 30_000, white_background=False)
    changes = [step for step in range(30_001) if schedule.densifies_at(step)]
    assert changes == list(range(600, 15_000, 100))
    assert schedule.resets == (3000, 6000, 9000, 12_000)
    assert schedule.prune_scale_after == 3000
    assert densify_schedule(DefaultStrategy(), 30_000, white_background=True).resets == (
        500,
        3000,
        6000,
        9000,
        12_000,
    )
    mcmc = densify_schedule(McmcStrategy(), 30_000, white_background=True)
    assert [step for step in range(30_001) if mcmc.densifies_at(step)] == list(
        range(600, 25_000, 100)
    )
    assert mcmc.resets == ()
    assert growth_per_change(30_000) == 0.05
    assert filter_steps(DefaultStrategy(), 30_000) == range(15_000, 29_901, 100)


@pytest.mark.parametrize(
    ("preset", "stop", "resets"),
    [
        ("4dgs", 18_000, (3000, 6000, 9000, 12_000, 15_000)),
        ("deformable_3dgs", 15_000, (3000, 6000, 9000, 12_000)),
    ],
)
def test_published_schedules_of_moving_scenes(
    preset: str, stop: int, resets: tuple[int, ...]
) -> None:
    """Both train a static model for 3,000 steps."""
    config = load_config(packaged_preset(preset), ["data.root=capture"])
    steps = config.train.steps
    assert isinstance(config.model, DynamicModel)
    assert isinstance(config.strategy, DefaultStrategy)
    schedule = densify_schedule(config.strategy, steps, config.data.background == "white")
    assert (schedule.start, schedule.stop, schedule.every) == (500, stop, 100)
    assert schedule.resets == resets
    assert grad_threshold(config.strategy, steps) == pytest.approx(2e-4, rel=2e-3)
    assert deform_schedule(config.model, RateSchedule(steps)).coarse_end == 3000
    assert [active_sh_degree(config.train, step, 3) for step in (999, 1000, 3000)] == [0, 1, 3]


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 60_000), st.booleans())
def test_opacity_resets_leave_steps_to_recover(steps: int, white: bool) -> None:
    schedule = densify_schedule(DefaultStrategy(), steps, white)
    resets = (*schedule.resets, schedule.stop)
    gaps = [b - a for a, b in pairwise(resets)]
    assert all(gap >= MIN_RESET_GAP for gap in gaps)
    assert schedule.start >= 100
    assert schedule.stop <= max(1, steps // 2 + 1)


@pytest.mark.parametrize(
    ("steps", "every"), [(1, 1), (500, 25), (1000, 50), (2000, 100), (30_000, 100)]
)
def test_short_runs_densify_as_often(steps: int, every: int) -> None:
    for strategy in (DefaultStrategy(), McmcStrategy()):
        assert densify_schedule(strategy, steps, white_background=False).every == every
        requested = strategy.model_copy(update={"every": 7})
        assert densify_schedule(requested, steps, white_background=False).every == 7


def _config(
    steps: int, optim: OptimConfig | None = None, model: SceneModel | None = None
) -> Config:
    train = TrainConfig(steps=steps)
    optim = optim or OptimConfig()
    return Config(
        data=DataConfig(root=Path("capture")),
        model=model or StaticModel(),
        optim=optim,
        train=train,
    )


def test_rates_of_a_static_scene_fit_the_length() -> None:
    """Published rates from the published length on. Shorter runs have higher rates, means most."""
    factors = [
        rate_factors(_config(steps)) for steps in (1, 500, 2000, 7000, 29_999, 30_000, 90_000)
    ]
    assert factors == sorted(factors, reverse=True)
    assert factors[0] == factors[1] == pytest.approx((60 ** (1 / 2), 60 ** (1 / 3)))
    assert factors[-2:] == [(1, 1), (1, 1)]
    assert all(of_means > of_others for of_means, of_others in factors[:-2])
    assert rate_factors(_config(500, OptimConfig(rate_factor=1.5))) == (1.5, 1.5)


@pytest.mark.parametrize("model", [HumanModel(), DynamicModel()])
def test_deformation_rates_are_the_published_ones_at_any_length(model: SceneModel) -> None:
    assert rate_factors(_config(500, model=model)) == (1, 1)
    assert rate_factors(_config(500, OptimConfig(rate_factor=2), model)) == (2, 2)


def test_free_primitives_learn_twice_as_fast_at_any_length() -> None:
    model = DynamicModel(deform=FreeField())
    assert rate_factors(_config(500, model=model)) == (2, 2)
    assert rate_factors(_config(90_000, model=model)) == (2, 2)
    assert rate_factors(_config(500, OptimConfig(rate_factor=1), model)) == (1, 1)


def test_means_rate_is_log_linear_times_the_extent() -> None:
    options = OptimConfig()
    assert means_rate(options, 0.0, 2.0) == pytest.approx(3.2e-4)
    assert means_rate(options, 0.5, 2.0) == pytest.approx(2 * 1.6e-5)
    assert means_rate(options, 1.0, 2.0) == pytest.approx(3.2e-6)


@pytest.mark.parametrize(("steps", "every"), [(30_000, 1000), (7000, 233), (2000, 67), (10, 1)])
def test_sh_degree_rises_at_the_scaled_steps(steps: int, every: int) -> None:
    options = TrainConfig(steps=steps)
    degrees = [
        active_sh_degree(options, step, 3) for step in (1, every, 2 * every, 3 * every, 9 * every)
    ]
    assert degrees == ([0, 1, 2, 3, 3] if every > 1 else [1, 1, 2, 3, 3])
    assert active_sh_degree(options, steps, 0) == 0


@pytest.mark.parametrize("steps", [1, 20, 7000, 30_000, 300_000])
def test_growth_is_the_published_one_or_up_to_a_quarter_more(steps: int) -> None:
    assert GROWTH <= growth_per_change(steps) <= MAX_GROWTH


@settings(max_examples=150, deadline=None)
@given(st.integers(1, 30_000), st.floats(0, 1), st.floats(0, 1))
def test_phases_of_a_dynamic_model_come_in_order(
    steps: int, coarse: float, time_window_full_at: float
) -> None:
    """The order is coarse, fine, all times, splits. All lie within the run, and the coarse phase
    is never empty.
    """
    model = DynamicModel(motion_from=coarse, time_window_full_at=time_window_full_at)
    schedule = deform_schedule(model, RateSchedule(steps))
    assert schedule.rates.steps == steps
    assert 1 <= schedule.coarse_end <= schedule.window_full_at <= steps
    assert all(schedule.window_full_at < split <= steps for split in schedule.freeze_steps)
    assert list(schedule.freeze_steps) == sorted(set(schedule.freeze_steps))
    assert (
        deform_schedule(
            model.model_copy(update={"freeze_below_px": 0.0}), RateSchedule(steps)
        ).freeze_steps
        == ()
    )


@pytest.mark.parametrize(
    ("coarsest", "expected"),
    [(1, {1}), (2, {2, 1}), (8, {8, 4, 2, 1})],
    ids=["never", "one level", "three levels"],
)
def test_images_sharpen_in_even_steps(coarsest: int, expected: set[int]) -> None:
    options = TrainConfig.model_validate(
        {
            "steps": 1000,
            "initial_downscale": coarsest,
            "resolution_grows_from": 0.3,
            "resolution_full_at": 0.6,
        }
    )
    divisors = [image_divisor(options, step) for step in range(1, 1001)]
    assert set(divisors) == expected
    assert divisors == sorted(divisors, reverse=True)
    assert set(divisors[:299]) == {coarsest}
    assert set(divisors[600:]) == {1}
    if coarsest == 8:
        assert [divisors.index(x) + 1 for x in (4, 2, 1)] == [300, 450, 600]


@given(st.integers(1, 1000), st.floats(0, 1))
def test_rates_fall_once_over_training(steps: int, fraction: float) -> None:
    rates = RateSchedule(steps)
    since = int(fraction * (steps - 1))
    progress = [rates.progress(step, since) for step in range(steps + 20)]
    assert progress == sorted(progress)
    assert progress[: since + 1] == [0] * (since + 1)
    assert progress[steps:] == [1] * 20
    assert progress[steps - 1] < 1


def test_rate_restarts_and_decays_again_in_a_new_stage() -> None:
    rates = RateSchedule(1000, 200)
    assert rates.progress(1000) == 1
    assert rates.progress(1001) == pytest.approx(0.3 + 0.7 / 200)
    assert rates.progress(1100) == pytest.approx(0.65)
    assert rates.progress(1200) == rates.progress(5000) == 1
    assert rates.progress(1100, since=300) == pytest.approx(0.5), (
        "rates that fall from step 300 on are half-way"
    )
    assert rates.progress(1001, since=600) == 0, "they do not rise above their first value"
