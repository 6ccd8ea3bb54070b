"""Steps of a run of any length, of numbers that were published for 30,000 steps."""

from __future__ import annotations

from dyngs.config import TrainConfig

PUBLISHED_STEPS = 30_000


def scaled(step: int, steps: int) -> int:
    """Return ``step`` of a 30,000-step run in a run of ``steps``; at least 1."""
    return max(1, round(step * steps / PUBLISHED_STEPS))


def image_divisor(options: TrainConfig, step: int) -> int:
    """Return the divisor of the images' sides at ``step``: ``initial_downscale``, halved evenly
    until it is 1."""
    halvings = options.initial_downscale.bit_length() - 1
    first = options.resolution_grows_from
    last = max(options.resolution_grows_from, options.resolution_full_at)
    fractions = [first + (last - first) * i / max(halvings - 1, 1) for i in range(halvings)]
    return options.initial_downscale >> sum(
        step / options.steps >= fraction for fraction in fractions
    )
