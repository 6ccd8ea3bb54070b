"""Everything of Gaussians that depends on the step, scaled from 30,000 steps to the length of the
run."""

from __future__ import annotations

import math
from dataclasses import dataclass

from typing_extensions import assert_never

from dyngs.config import Config, DefaultStrategy, McmcStrategy, OptimConfig, Strategy, TrainConfig
from dyngs.gaussians.densify import DensifySchedule
from dyngs.models.kind import HasGaussians, capability
from dyngs.models.schedule import PUBLISHED_STEPS, scaled

MIN_START = 100  # Densification never starts earlier: the first gradients say little
# Steps that opacities need to recover from a reset (at a rate of 0.05 from logit -4.6)
MIN_RESET_GAP = 400
RESET_FRACTION = 0.2  # Fraction of a short run between opacity resets
MOST_BETWEEN_CHANGES, CHANGE_FRACTION = 100, 0.05
"""Steps between changes of the set, at most and as a fraction of the run: a short run has ten of
them, too."""
MEANS_POWER = 1 / 2
POWER = 1 / 3
SHORTEST = 500
"""Powers of 30,000 / steps that learning rates of positions, and all others, are multiplied by
(docs/benchmarks.md); those of runs shorter than the last are its own."""
GROWTH, MAX_GROWTH = 0.05, 0.25
"""Fraction of Gaussians that MCMC adds per change in 30,000 steps, and most in a shorter run."""
FILTER_EVERY = 100
REWIND = 0.3
"""Fraction of training whose rates fine-tuning goes back to, to fall again (Renda et al. 2020)."""


@dataclass(frozen=True)
class RateSchedule:
    """The course of all learning rates that fall over a run."""

    steps: int
    # steps of a stage after that, with fewer Gaussians, whose rates begin at ``REWIND``
    tuning: int = 0

    def progress(self, step: int, since: int = 0) -> float:
        """Return 0 up to step ``since``, rising to 1 at the end: the progress of rates that fall
        from ``since`` on."""
        at = float(step)
        if step > self.steps:
            tuned = min((step - self.steps) / max(self.tuning, 1), 1.0)
            at = self.steps * (REWIND + (1 - REWIND) * tuned)
        return min(max((at - since) / max(self.steps - since, 1), 0.0), 1.0)


def rate_schedule(config: Config) -> RateSchedule:
    """Return the course of the learning rates of a run."""
    return RateSchedule(config.train.steps, config.prune.steps)


def rate_factors(config: Config) -> tuple[float, float]:
    """Return the factors on the learning rates of positions and of all else, where the published
    ones have 1.

    In fewer steps what is learned has to come as far. ``optim.rate_factor`` decides; else the
    length of the run does, for static scenes: in a moving one, Gaussians that learn as fast repaint
    each image instead of following it.
    """
    asked = config.optim.rate_factor
    short = PUBLISHED_STEPS / max(SHORTEST, min(config.train.steps, PUBLISHED_STEPS))
    if asked is not None:
        return asked, asked
    kind = capability(config.model, HasGaussians)
    speeds_up = kind is not None and kind.speeds_up_short_runs
    return (short**MEANS_POWER, short**POWER) if speeds_up else (1.0, 1.0)


def learning_rates(config: Config) -> OptimConfig:
    """Return ``config.optim`` with the rates of this run: those given, times their factors."""
    given, (of_means, of_others) = config.optim, rate_factors(config)
    rates = {
        name: getattr(given, name) for name in OptimConfig.model_fields if name.startswith("lr_")
    }
    changed = {
        k: rate * (of_means if k.startswith("lr_means") else of_others) for k, rate in rates.items()
    }
    return given.model_copy(update=changed | {"rate_factor": 1.0})


def means_rate(options: OptimConfig, progress: float, extent: float) -> float:
    """Return the learning rate of the means, world units: log-linear in ``progress`` in [0, 1],
    times the extent."""
    return extent * math.exp(
        (1 - progress) * math.log(options.lr_means) + progress * math.log(options.lr_means_final)
    )


def active_sh_degree(options: TrainConfig, step: int, max_degree: int) -> int:
    """Return the SH degree drawn at ``step``: one more each ``sh_every`` (scaled) steps."""
    return min(max_degree, step // scaled(options.sh_every, options.steps))


def densify_schedule(
    strategy: DefaultStrategy | McmcStrategy, steps: int, white_background: bool
) -> DensifySchedule:
    """Return the steps at which ``strategy`` changes the set of Gaussians in a run of ``steps``.

    Opacities need as many steps to recover from a reset in a short run as in a long one. So resets
    are a fifth of the run apart, within [``MIN_RESET_GAP``, the published 3000], and the last is
    one period before densification stops (at 30,000: 3000, 6000, 9000, 12,000; at 7,000: 1400). On
    a white background the published schedule has one more at the start, which clears white
    floaters; in shorter runs it costs more than it brings.
    """
    start = max(scaled(strategy.start, steps), min(strategy.start, MIN_START))
    stop = scaled(strategy.stop, steps)
    every = steps_between_changes(strategy, steps)
    match strategy:
        case McmcStrategy():
            return DensifySchedule(start, stop, every)
        case DefaultStrategy():
            reset_every = strategy.reset_every
            if reset_every is None:
                return DensifySchedule(start, stop, every, prune_scale_after=steps)
            recovery = max(MIN_RESET_GAP, round(RESET_FRACTION * steps))
            period = max(scaled(reset_every, steps), min(reset_every, recovery))
            resets = tuple(range(period, stop - period + 1, period))
            if white_background and steps >= PUBLISHED_STEPS and start < period:
                resets = (start, *resets)
            return DensifySchedule(start, stop, every, resets, prune_scale_after=period)
        case _:
            assert_never(strategy)


def steps_between_changes(strategy: DefaultStrategy | McmcStrategy, steps: int) -> int:
    """Return the steps between changes of the set of Gaussians in a run of ``steps``."""
    return strategy.every or max(1, min(MOST_BETWEEN_CHANGES, round(CHANGE_FRACTION * steps)))


def grad_threshold(strategy: DefaultStrategy, steps: int) -> float:
    """Return the gradient norm from which Gaussians are cloned or split in a run of ``steps``.

    A short run has fewer changes; a lower threshold makes up for it. The fourth root was measured
    on lego: +0.5 dB at 2,000 steps, +0.3 dB at 7,000.
    """
    return strategy.grad_threshold * min(1.0, steps / PUBLISHED_STEPS) ** 0.25


def growth_per_change(steps: int) -> float:
    """Return the fraction of Gaussians that MCMC adds per change.

    A short run has fewer changes; each then adds more, up to a quarter, and the count follows the
    same curve.
    """
    rate = math.log1p(GROWTH) * max(PUBLISHED_STEPS / steps, 1.0)
    return max(GROWTH, math.expm1(min(rate, math.log1p(MAX_GROWTH))))


def filter_steps(strategy: Strategy, steps: int) -> range:
    """Return the steps after which Mip-Splatting's 3D filter is recomputed: each 100 after
    densification ends."""
    first = -(-scaled(strategy.stop, steps) // FILTER_EVERY) * FILTER_EVERY
    return range(first, steps - FILTER_EVERY + 1, FILTER_EVERY)
