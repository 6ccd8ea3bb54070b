"""Training phases of dynamic scenes, and the window of times that each step trains on.

The window grows from the middle of the clip to all times. Motion over a whole clip may exceed the
size of the object. A few images around one time give a sharp canonical model, from which the field
follows small further motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

from dyngs.core.errors import DyngsError
from dyngs.deform.keys import DynamicModel
from dyngs.gaussians.schedule import RateSchedule
from dyngs.models.schedule import LengthChange

FREEZE_FRACTIONS = (0.1, 0.3, 0.5)
"""Steps at which Gaussians are frozen, as fractions of the steps after the window is full."""


@dataclass(frozen=True)
class DeformSchedule:
    """Steps at which the training phases start."""

    coarse_end: int  # last step of the static model
    # The time window grows between these steps.
    window_grows_from: int
    window_full_at: int
    decay_from: int  # step from which the field's learning rates decay
    freeze_steps: tuple[int, ...]  # steps after which Gaussians without visible motion are frozen
    rates: RateSchedule


def deform_schedule(model: DynamicModel, rates: RateSchedule) -> DeformSchedule:
    """Return the training phases of a dynamic model; with ``freeze_below_px`` 0 nothing is frozen.

    The learning rate of the field is constant while the window grows, because it must follow new
    motion.
    """
    steps = rates.steps
    coarse_end = model.motion_start_step(steps)
    window_grows_from = max(coarse_end, round(model.time_window_grows_from * steps))
    window_full_at = max(window_grows_from, round(model.time_window_full_at * steps))
    decay_from = window_full_at if model.time_window < 1 else coarse_end
    after = {round(fraction * (steps - window_full_at)) for fraction in FREEZE_FRACTIONS} - {0}
    freeze_steps = tuple(window_full_at + x for x in sorted(after) if model.freeze_below_px > 0)
    return DeformSchedule(
        coarse_end, window_grows_from, window_full_at, decay_from, freeze_steps, rates
    )


def extend_schedules(model: DynamicModel, length: LengthChange) -> DynamicModel:
    """Return the model section for a run of another length; phases that have started keep their
    step.

    Raises DyngsError if motion started too early for the new length.
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


def _motion_from(old: DeformSchedule, model: DynamicModel, length: LengthChange) -> float:
    """Return the fraction of the run after which motion starts, as it was or at the next step."""
    if length.done >= old.coarse_end:
        return length.kept(old.coarse_end)
    new = deform_schedule(model, RateSchedule(length.steps))
    return length.kept(length.done + 1) if new.coarse_end <= length.done else model.motion_from


MIN_WINDOW_VIEWS = 6
MIDDLE = 0.5
FRONTIER_VIEWS = 6
"""Newest views, at the ends of the window, that every other step trains on while it grows."""


@dataclass(frozen=True)
class TimeWindow:
    """Times that each step trains on."""

    times: Sequence[float]
    initial_fraction: float
    schedule: DeformSchedule
    _limits: dict[int, tuple[float, float]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @cached_property
    def time_offsets(self) -> list[float]:
        """Ascending |time - 0.5| of the training views."""
        return sorted(abs(time - MIDDLE) for time in self.times)

    def num_views(self, step: int) -> int:
        start = min(
            len(self.time_offsets),
            max(MIN_WINDOW_VIEWS, math.ceil(self.initial_fraction * len(self.time_offsets))),
        )
        first = self.schedule.window_grows_from
        last = self.schedule.window_full_at
        progress = (step - first) / max(last - first, 1)
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
        """Return whether ``step`` trains on ``time``; frontier steps train on the newest times
        only."""
        # ``bounds`` is rounded and could exclude the outermost times.
        if step <= self.schedule.coarse_end:
            return True
        if step not in self._limits:  # cached, because all views call this
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
        """Return whether ``step`` trains on the newest views only: every other step while it
        grows."""
        return (
            self.schedule.window_grows_from < step < self.schedule.window_full_at
            and step % 2 == 0
            and self.num_views(step) < len(self.time_offsets)
        )
