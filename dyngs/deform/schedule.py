"""The steps at which the phases of a moving scene begin, and the part of a clip that each step trains on.

The window of times starts around the middle and grows until it is all. Motion over a whole clip may
be far larger than the thing that moves. From the few images around one moment a sharp canonical form
can be had, and a field that has followed it so far needs little to follow it a little farther.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from dyngs.core.errors import DyngsError
from dyngs.deform.keys import DynamicModel
from dyngs.gaussians.schedule import RateSchedule
from dyngs.models.schedule import Length

SPLITS = (0.1, 0.3, 0.5)
"""Steps at which static Gaussians are frozen, as fractions of the part of the run that sees all
times."""


@dataclass(frozen=True)
class DeformSchedule:
    """The steps at which the phases of training begin."""

    coarse_end: int  # last step without motion
    # opens, full: steps between which the window of times grows, to all of them
    window_grows_from: int
    window_full_at: int
    decay_from: int  # step from which the field's rates fall
    freeze_steps: tuple[int, ...]  # steps after which Gaussians that do not move are frozen
    rates: RateSchedule


def deform_schedule(model: DynamicModel, rates: RateSchedule) -> DeformSchedule:
    """Return the phases of a dynamic model in a run with ``rates``; ``freeze_below_px`` 0 freezes
    nothing.

    While new times come in, the field learns at its first rate: what has slowed down follows
    nothing.
    """
    steps = rates.steps
    coarse_end = model.motion_start_step(steps)
    window_grows_from = max(coarse_end, round(model.time_window_grows_from * steps))
    window_full_at = max(window_grows_from, round(model.time_window_full_at * steps))
    decay_from = window_full_at if model.time_window < 1 else coarse_end
    freeze_steps = (
        sorted({window_full_at + round(fraction * (steps - window_full_at)) for fraction in SPLITS})
        if model.freeze_below_px > 0
        else []
    )
    freeze_steps = tuple(step for step in freeze_steps if step > window_full_at)
    return DeformSchedule(
        coarse_end, window_grows_from, window_full_at, decay_from, freeze_steps, rates
    )


def extend_schedules(model: DynamicModel, length: Length) -> DynamicModel:
    """Return the section for a run of another length; phases that have begun keep their step.

    Raises DyngsError: its motion began too early for that length.
    """
    old = deform_schedule(model, RateSchedule(length.was))
    fractions = {"motion_from": _motion_from(old, model, length)}
    if length.done >= old.window_grows_from:
        fractions |= {
            "time_window_grows_from": length.kept(old.window_grows_from),
            "time_window_full_at": length.kept(old.window_full_at),
        }
    changed = model.model_copy(update=fractions)
    motion_start = changed.motion_start_step(length.steps)
    if old.coarse_end <= length.done < motion_start:
        raise DyngsError(
            f"train.steps={length.steps}: motion began after step {old.coarse_end:,}, but a run of "
            f"{length.steps:,} steps trains {motion_start:,} static steps; start a new run"
        )
    return changed


def _motion_from(old: DeformSchedule, model: DynamicModel, length: Length) -> float:
    """Return the share after which motion is learned: the step where it began, else one that is
    still to come."""
    if length.done >= old.coarse_end:
        return length.kept(old.coarse_end)
    new = deform_schedule(model, RateSchedule(length.steps))
    return length.kept(length.done + 1) if new.coarse_end <= length.done else model.motion_from


MIN_VIEWS = 6
MIDDLE = 0.5
FRONTIER_VIEWS = 6
"""Number of newest views, at the window's ends, that every other step trains on while the window
grows."""


@dataclass(frozen=True)
class TimeWindow:
    """The times that are trained on at each step."""

    time_offsets: tuple[float, ...]
    first: float
    motion_start: int
    window_grows_from: int
    window_full_at: int
    _limits: dict[int, tuple[float, float]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @staticmethod
    def around_middle(
        times: Sequence[float],
        first: float,
        motion_start: int,
        window_grows_from: int,
        window_full_at: int,
    ) -> TimeWindow:
        return TimeWindow(
            tuple(sorted(abs(time - MIDDLE) for time in times)),
            first,
            motion_start,
            window_grows_from,
            window_full_at,
        )

    def num_views(self, step: int) -> int:
        start = min(
            len(self.time_offsets), max(MIN_VIEWS, math.ceil(self.first * len(self.time_offsets)))
        )
        progress = (step - self.window_grows_from) / max(
            self.window_full_at - self.window_grows_from, 1
        )
        return start + int(min(max(progress, 0.0), 1.0) * (len(self.time_offsets) - start))

    def reach(self, step: int) -> float:
        """Return the largest |time - 0.5| in the window at ``step``; 0.5 once it is full."""
        count = self.num_views(step)
        return MIDDLE if count == len(self.time_offsets) else self.time_offsets[count - 1]

    def bounds(self, step: int) -> tuple[float, float]:
        """Return the first and last time in the window at ``step``; [0, 1] once it is full."""
        reach = self.reach(step)
        return MIDDLE - reach, MIDDLE + reach

    def contains(self, time: float, step: int) -> bool:
        """Return whether ``time`` is trained on at ``step``; while it grows, every other step takes
        only new times."""
        # Not by ``bounds``: their rounding may shut out the very times that the window ends with.
        if step <= self.motion_start:
            return True
        if step not in self._limits:  # once, though all views ask
            oldest = (
                self.time_offsets[max(self.num_views(step) - FRONTIER_VIEWS, 0)]
                if self.is_frontier_step(step)
                else 0.0
            )
            self._limits.clear()
            self._limits[step] = oldest, self.reach(step)
        oldest, newest = self._limits[step]
        return oldest <= abs(time - MIDDLE) <= newest

    def is_frontier_step(self, step: int) -> bool:
        """Return whether ``step`` is for the newest views only: every other one while the window
        grows."""
        return (
            self.window_grows_from < step < self.window_full_at
            and step % 2 == 0
            and self.num_views(step) < len(self.time_offsets)
        )
