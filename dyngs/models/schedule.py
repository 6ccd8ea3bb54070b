"""Steps of a run of any length, of numbers that were published for 30,000 steps."""

from __future__ import annotations

from dataclasses import dataclass

from dyngs.config import TrainConfig

PUBLISHED_STEPS = 30_000


@dataclass(frozen=True)
class LengthChange:
    """A change of the length of a run."""

    done: int
    was: int
    steps: int

    def kept(self, step: int | float) -> float:
        """Return the fraction of the new length at which ``step`` of the old one lies, at most
        1."""
        return min(step / self.steps, 1.0)

    def share(self, fraction: float) -> float:
        """Return the fraction of the new length for what began, or shall begin, after ``fraction``
        of a run."""
        if self.done >= round(fraction * self.was):
            return self.kept(fraction * self.was)
        return (
            max(fraction, self.kept(self.done + 1))
            if self.done >= round(fraction * self.steps)
            else fraction
        )


def scale_step(step: int, steps: int) -> int:
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
