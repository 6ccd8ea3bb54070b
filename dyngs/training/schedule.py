"""Everything that depends on the step: numbers published for 30,000 steps, scaled to the length of the run."""

from __future__ import annotations

import math

from typing_extensions import assert_never

from dyngs.config import (
    Config,
    DefaultStrategy,
    DynamicModel,
    HumanModel,
    HumanPredictorModel,
    McmcStrategy,
    OptimConfig,
    StaticModel,
    Strategy,
    TrainConfig,
)
from dyngs.deform.training import DeformSchedule
from dyngs.static.densify import DensifySchedule
from dyngs.static.rates import Rates

PUBLISHED_STEPS = 30_000
MIN_START = 100
"""Densification never starts earlier: the first gradients say little."""
MIN_RESET_GAP = 400
"""Steps that opacities need to recover from a reset (at a rate of 0.05 from logit -4.6)."""
RESET_FRACTION = 0.2
"""Fraction of a short run between opacity resets."""
GROWTH, MAX_GROWTH = 0.05, 0.25
"""Fraction of Gaussians that MCMC adds per change in 30,000 steps, and most in a shorter run."""
FILTER_EVERY = 100
MIN_COARSE_STEPS = 1000
"""Steps that a static model needs to show where it fails; short runs spend at most a third on it."""
SPLITS = (0.1, 0.3, 0.5)
"""Steps at which static Gaussians are frozen, as fractions of the part of the run that sees all times."""


def scaled(step: int, steps: int) -> int:
    """Return ``step`` of a 30,000-step run in a run of ``steps``; at least 1."""
    return max(1, round(step * steps / PUBLISHED_STEPS))


def image_divisor(options: TrainConfig, step: int) -> int:
    """Return the divisor of the images' sides at ``step``: ``initial_downscale``, halved evenly until it is 1."""
    halvings = options.initial_downscale.bit_length() - 1
    first, last = options.resolution_grows_from, max(options.resolution_grows_from, options.resolution_full_at)
    fractions = [first + (last - first) * i / max(halvings - 1, 1) for i in range(halvings)]
    return options.initial_downscale >> sum(step / options.steps >= fraction for fraction in fractions)


def rates_of(config: Config) -> Rates:
    """Return the course of the learning rates of a run."""
    return Rates(config.train.steps, config.prune.steps)


def means_rate(options: OptimConfig, progress: float, extent: float) -> float:
    """Return the learning rate of the means, world units: log-linear in ``progress`` in [0, 1], times the extent."""
    return extent * math.exp((1 - progress) * math.log(options.lr_means) + progress * math.log(options.lr_means_final))


def active_sh_degree(options: TrainConfig, step: int, max_degree: int) -> int:
    """Return the SH degree drawn at ``step``: one more each ``sh_every`` (scaled) steps."""
    return min(max_degree, step // scaled(options.sh_every, options.steps))


def densify_schedule(strategy: DefaultStrategy | McmcStrategy, steps: int, white_background: bool) -> DensifySchedule:
    """Return the steps at which ``strategy`` changes the set of Gaussians in a run of ``steps``.

    Opacities need as many steps to recover from a reset in a short run as in a long one. So resets are a fifth of the
    run apart, within [``MIN_RESET_GAP``, the published 3000], and the last is one period before densification stops (at
    30,000: 3000, 6000, 9000, 12,000; at 7,000: 1400). On a white background the published schedule has one more at the
    start, which clears white floaters; in shorter runs it costs more than it brings.
    """
    start = max(scaled(strategy.start, steps), min(strategy.start, MIN_START))
    stop = scaled(strategy.stop, steps)
    match strategy:
        case McmcStrategy():
            return DensifySchedule(start, stop, strategy.every)
        case DefaultStrategy():
            every = strategy.reset_every
            if every is None:
                return DensifySchedule(start, stop, strategy.every, prune_scale_after=steps)
            recovery = max(MIN_RESET_GAP, round(RESET_FRACTION * steps))
            period = max(scaled(every, steps), min(every, recovery))
            resets = tuple(range(period, stop - period + 1, period))
            if white_background and steps >= PUBLISHED_STEPS and start < period:
                resets = (start, *resets)
            return DensifySchedule(start, stop, strategy.every, resets, prune_scale_after=period)
        case _:
            assert_never(strategy)


def grad_threshold(strategy: DefaultStrategy, steps: int) -> float:
    """Return the gradient norm from which Gaussians are cloned or split in a run of ``steps``.

    Changes come every ``every`` steps whatever the run's length, so that a short run has fewer of them; a lower
    threshold makes up for it. The fourth root was measured on lego: +0.5 dB at 2,000 steps, +0.3 dB at 7,000.
    """
    return strategy.grad_threshold * min(1.0, steps / PUBLISHED_STEPS) ** 0.25


def growth_per_change(steps: int) -> float:
    """Return the fraction of Gaussians that MCMC adds per change.

    Changes come every ``every`` steps whatever the run's length, so that a short run has fewer of them; each then adds
    more, up to a quarter, and the count follows the same curve over the run.
    """
    rate = math.log1p(GROWTH) * max(PUBLISHED_STEPS / steps, 1.0)
    return max(GROWTH, math.expm1(min(rate, math.log1p(MAX_GROWTH))))


def filter_steps(strategy: Strategy, steps: int) -> range:
    """Return the steps after which Mip-Splatting's 3D filter is recomputed: each 100 after densification ends."""
    first = -(-scaled(strategy.stop, steps) // FILTER_EVERY) * FILTER_EVERY
    return range(first, steps - FILTER_EVERY + 1, FILTER_EVERY)


def deform_schedule(model: DynamicModel, rates: Rates) -> DeformSchedule:
    """Return the phases of a dynamic model in a run with ``rates``; ``freeze_below_px`` 0 freezes nothing.

    While new times come in, the field learns at its first rate: what has slowed down follows nothing.
    """
    steps = rates.steps
    fine = min(max(1, round(model.motion_from * steps), min(MIN_COARSE_STEPS, steps // 3)), steps)
    opens = max(fine, round(model.time_window_grows_from * steps))
    full = max(opens, round(model.time_window_full_at * steps))
    decays = full if model.time_window < 1 else fine
    splits = (
        sorted({full + round(fraction * (steps - full)) for fraction in SPLITS}) if model.freeze_below_px > 0 else []
    )
    splits = tuple(step for step in splits if step > full)
    return DeformSchedule(fine, opens, full, decays, splits, rates)


def motion_begins_after(config: Config, steps: int) -> int | None:
    """Return the last step without motion in a run of ``steps``; None where nothing will move."""
    match config.model:
        case DynamicModel():
            return deform_schedule(config.model, Rates(steps)).fine
        case StaticModel() | HumanModel() | HumanPredictorModel():
            return None
        case _:
            assert_never(config.model)
