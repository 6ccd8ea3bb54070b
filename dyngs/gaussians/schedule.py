"""Schedules of Gaussian training, scaled from 30,000 steps to the length of the run."""

from __future__ import annotations

import math
from dataclasses import dataclass

from typing_extensions import assert_never

from dyngs.config import Config, DefaultStrategy, McmcStrategy, OptimConfig, Strategy, TrainConfig
from dyngs.gaussians.densify import DensifySchedule
from dyngs.models.kind import HasGaussians, capability
from dyngs.models.schedule import PUBLISHED_STEPS, scale_step

MIN_START = 100  # densification never starts earlier: the first gradients are noise
# Steps that opacities need to recover from a reset (learning rate 0.05, from logit -4.6).
MIN_RESET_GAP = 400
RESET_FRACTION = 0.2  # opacity reset interval, as a fraction of a short run
MAX_INTERVAL, INTERVAL_FRACTION = 100, 0.05
"""Steps between densifications: at most, and as a fraction of a short run."""
MEANS_POWER = 1 / 2
OTHERS_POWER = 1 / 3
SHORTEST = 500
"""Exponents of 30,000 / steps in the learning rate factors of means and of all other parameters.

Runs shorter than ``SHORTEST`` use the factors of ``SHORTEST`` (docs/benchmarks/index.md).
"""
GROWTH, MAX_GROWTH = 0.05, 0.25
"""Fraction of Gaussians that MCMC adds per change in 30,000 steps, and the maximum in shorter
runs."""
FILTER_EVERY = 100
REWIND = 0.3
"""Fraction of training to which fine-tuning rewinds the learning rates (Renda et al. 2020)."""


@dataclass(frozen=True)
class RateSchedule:
    """Progress of the learning rates that decay over a run."""

    steps: int
    # Fine-tuning steps after pruning; their rates start at ``REWIND``.
    tuning: int = 0

    def progress(self, step: int, since: int = 0) -> float:
        """Return 0 up to step ``since``, then rising linearly to 1 at the end of the run."""
        at = float(step)
        if step > self.steps:
            tuned = min((step - self.steps) / max(self.tuning, 1), 1.0)
            at = self.steps * (REWIND + (1 - REWIND) * tuned)
        return min(max((at - since) / max(self.steps - since, 1), 0.0), 1.0)


def rate_schedule(config: Config) -> RateSchedule:
    """Return the learning rate schedule of a run."""
    return RateSchedule(config.train.steps, config.prune.steps)


def rate_factors(config: Config) -> tuple[float, float]:
    """Return the learning rate factors of means and of all other parameters.

    ``optim.rate_factor`` takes precedence. Otherwise short runs of static scenes need larger rates,
    and free primitives in runs of any length. With other fields, faster Gaussians repaint each
    image instead of following the motion, except in clips, see ``dyngs.deform.start``.
    """
    factor = config.optim.rate_factor
    kind = capability(config.model, HasGaussians)
    if factor is None and kind is not None:
        if kind.speeds_up_short_runs:
            short = PUBLISHED_STEPS / max(SHORTEST, min(config.train.steps, PUBLISHED_STEPS))
            return short**MEANS_POWER, short**OTHERS_POWER
        factor = kind.rate_factor(config.model)
    return (1.0, 1.0) if factor is None else (factor, factor)


def learning_rates(config: Config) -> OptimConfig:
    """Return ``config.optim`` with all learning rates multiplied by the factors of this run."""
    given, (of_means, of_others) = config.optim, rate_factors(config)
    rates = {
        name: getattr(given, name) for name in OptimConfig.model_fields if name.startswith("lr_")
    }
    changed = {
        k: rate * (of_means if k.startswith("lr_means") else of_others) for k, rate in rates.items()
    }
    return given.model_copy(update=changed | {"rate_factor": 1.0})


def means_rate(options: OptimConfig, progress: float, extent: float) -> float:
    """Return the learning rate of the means in world units: log-linear in ``progress``, times the
    extent."""
    return extent * math.exp(
        (1 - progress) * math.log(options.lr_means) + progress * math.log(options.lr_means_final)
    )


def active_sh_degree(options: TrainConfig, step: int, max_degree: int) -> int:
    """Return the SH degree at ``step``: one more every ``sh_every`` (scaled) steps."""
    return min(max_degree, step // scale_step(options.sh_every, options.steps))


def densify_schedule(
    strategy: DefaultStrategy | McmcStrategy, steps: int, white_background: bool
) -> DensifySchedule:
    """Return the densification schedule of ``strategy`` in a run of ``steps``.

    Opacities need the same number of steps to recover from a reset in short and long runs. Resets
    are therefore a fifth of the run apart, within [``MIN_RESET_GAP``, the published 3000]. The
    last reset is one period before densification stops. Full-length runs on a white background
    have one more reset at the start, as published, which removes white floaters.
    """
    start = max(scale_step(strategy.start, steps), min(strategy.start, MIN_START))
    stop = scale_step(strategy.stop, steps)
    every = strategy.every or max(1, min(MAX_INTERVAL, round(INTERVAL_FRACTION * steps)))
    match strategy:
        case McmcStrategy():
            return DensifySchedule(start, stop, every)
        case DefaultStrategy():
            reset_every = strategy.reset_every
            if reset_every is None:
                return DensifySchedule(start, stop, every, prune_scale_after=steps)
            recovery = max(MIN_RESET_GAP, round(RESET_FRACTION * steps))
            period = max(scale_step(reset_every, steps), min(reset_every, recovery))
            resets = tuple(range(period, stop - period + 1, period))
            if white_background and steps >= PUBLISHED_STEPS and start < period:
                resets = (start, *resets)
            return DensifySchedule(start, stop, every, resets, prune_scale_after=period)
        case _:
            assert_never(strategy)


def grad_threshold(strategy: DefaultStrategy, steps: int) -> float:
    """Return the gradient threshold of cloning and splitting in a run of ``steps``.

    Short runs densify less often, which a lower threshold compensates. The fourth root was tuned
    on lego.
    """
    return strategy.grad_threshold * min(1.0, steps / PUBLISHED_STEPS) ** 0.25


def growth_per_change(steps: int) -> float:
    """Return the fraction of Gaussians that MCMC adds per change.

    Short runs have fewer changes, so each adds more, up to ``MAX_GROWTH``.
    """
    rate = math.log1p(GROWTH) * max(PUBLISHED_STEPS / steps, 1.0)
    return max(GROWTH, math.expm1(min(rate, math.log1p(MAX_GROWTH))))


def filter_steps(strategy: Strategy, steps: int) -> range:
    """Return the steps after which the 3D filter is recomputed: every 100 after densification
    stops."""
    first = -(-scale_step(strategy.stop, steps) // FILTER_EVERY) * FILTER_EVERY
    return range(first, steps - FILTER_EVERY + 1, FILTER_EVERY)
