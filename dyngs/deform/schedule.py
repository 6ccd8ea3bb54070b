"""The steps at which the phases of a moving scene begin."""

from __future__ import annotations

from dyngs.config import Config, ControlNodesField, DynamicModel
from dyngs.deform.training import DeformSchedule
from dyngs.gaussians.schedule import Rates

MIN_COARSE_STEPS = 1000
"""Steps that a static model needs to show where it fails; short runs spend at most a third on it."""
SPLITS = (0.1, 0.3, 0.5)
"""Steps at which static Gaussians are frozen, as fractions of the part of the run that sees all times."""
MATCH_FRACTION, MATCHES_UNTIL = 0.04, 0.85
"""Fraction of the run between two rounds of block matching, and after which there are no more."""
GROUPS = 0.12
"""The step at which nodes may form rigid groups, likewise: after the first split."""


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
    groups = full + round(GROUPS * (steps - full))
    return DeformSchedule(fine, opens, full, decays, splits, rates, groups, _matches(model, fine, steps))


def _matches(model: DynamicModel, fine: int, steps: int) -> tuple[int, ...]:
    """Return the steps after which block matching corrects motion that begins after ``fine``."""
    match model.deform:
        case ControlNodesField(block_matching=True):
            every = max(1, round(MATCH_FRACTION * steps))
            return tuple(range(fine + every, round(MATCHES_UNTIL * steps) + 1, every))
        case _:
            return ()


def motion_begins_after(config: Config, steps: int) -> int | None:
    """Return the last step without motion in a run of ``steps``; None where nothing will move."""
    return deform_schedule(config.model, Rates(steps)).fine if isinstance(config.model, DynamicModel) else None
