"""The steps at which the phases of a moving scene begin."""

from __future__ import annotations

from dyngs.config import DynamicModel
from dyngs.deform.training import DeformSchedule
from dyngs.gaussians.schedule import Rates

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
