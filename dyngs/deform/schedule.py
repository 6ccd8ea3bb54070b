"""The steps at which the phases of a moving scene begin."""

from __future__ import annotations

from dyngs.core.errors import DyngsError
from dyngs.deform.keys import DynamicModel
from dyngs.deform.training import DeformSchedule
from dyngs.gaussians.schedule import Rates
from dyngs.models.schedule import Length

SPLITS = (0.1, 0.3, 0.5)
"""Steps at which static Gaussians are frozen, as fractions of the part of the run that sees all
times."""


def deform_schedule(model: DynamicModel, rates: Rates) -> DeformSchedule:
    """Return the phases of a dynamic model in a run with ``rates``; ``freeze_below_px`` 0 freezes
    nothing.

    While new times come in, the field learns at its first rate: what has slowed down follows
    nothing.
    """
    steps = rates.steps
    fine = model.moves_after(steps)
    opens = max(fine, round(model.time_window_grows_from * steps))
    full = max(opens, round(model.time_window_full_at * steps))
    decays = full if model.time_window < 1 else fine
    splits = (
        sorted({full + round(fraction * (steps - full)) for fraction in SPLITS})
        if model.freeze_below_px > 0
        else []
    )
    splits = tuple(step for step in splits if step > full)
    return DeformSchedule(fine, opens, full, decays, splits, rates)


def extended(model: DynamicModel, length: Length) -> DynamicModel:
    """Return the section for a run that goes on to another length: what has begun keeps its step.

    Raises DyngsError: its motion began too early for that length.
    """
    old = deform_schedule(model, Rates(length.was))
    fractions = {"motion_from": _motion_from(old, model, length)}
    if length.done >= old.opens:
        fractions |= {
            "time_window_grows_from": length.kept(old.opens),
            "time_window_full_at": length.kept(old.full),
        }
    changed = model.model_copy(update=fractions)
    begins = changed.moves_after(length.steps)
    if old.fine <= length.done < begins:
        raise DyngsError(
            f"train.steps={length.steps}: motion began after {old.fine:,} steps, and a run of {length.steps:,} trains "
            f"{begins:,} before anything moves; train anew with so many steps"
        )
    return changed


def _motion_from(old: DeformSchedule, model: DynamicModel, length: Length) -> float:
    """Return the share after which motion is learned: the step where it began, else one that is
    still to come."""
    if length.done >= old.fine:
        return length.kept(old.fine)
    new = deform_schedule(model, Rates(length.steps))
    return length.kept(length.done + 1) if new.fine <= length.done else model.motion_from
