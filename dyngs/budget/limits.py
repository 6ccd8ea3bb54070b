"""Limits on the number of Gaussians, and what limits together are possible (docs/budget.md).

A limit on the file's size is one on the number of Gaussians first: so few that they fit when stored as exactly as is
usual.
"""

from __future__ import annotations

import torch

from dyngs.config import Config, DeformField, DynamicModel, HumanModel, HumanPredictorModel, NetworkColour
from dyngs.conventions import num_sh_terms
from dyngs.deform.field import FieldSetup
from dyngs.deform.fields import new_field
from dyngs.errors import DyngsError

SEED_SHARE = 0.1
"""Of the limit that is kept free for the Gaussians with which motion begins."""
SHAPE_BYTES, HARMONIC_BYTES, FIELD_BYTES = 16.0, 0.35, 1.0
"""Per Gaussian, per value of its harmonics, per number of a field: a little more than docs/storage.md measured."""
CLOSE = 0.8
"""Share of the limit from which on it is taken to have held growth back."""
FEWEST = 500
"""Gaussians; a limit on the size that has no room for them is refused."""


def require_possible(config: Config) -> None:
    """Raise DyngsError where limits of ``config`` contradict it or each other."""
    budget = config.budget
    given = [name for name, value in budget.model_dump().items() if value is not None]
    if given and isinstance(config.model, HumanPredictorModel):
        raise DyngsError(f"budget.{given[0]}: a network has no budget; leave it out")
    if budget.max_minutes is not None and config.prune.is_wanted:
        raise DyngsError(
            "budget.max_minutes: how long the stage of prune.* takes cannot be foreseen; leave that out and run "
            "`dyngs compact` afterwards"
        )


def within_cap(config: Config, num_times: int) -> Config:
    """``config`` with what decides the number of Gaussians lowered to its limits; the same object where it has none.

    Args:
        config: of a run.
        num_times: distinct times of training; fewer than two: nothing will move.

    Raises:
        DyngsError: a size that has no room for a scene.
    """
    cap, model = most_gaussians(config, num_times), config.model
    if cap is None:
        return config
    if isinstance(model, DynamicModel):
        model = model.model_copy(update={"num_random_moving": min(model.num_random_moving, int(SEED_SHARE * cap))})
        cap -= model.num_random_moving
    return config.model_copy(update={"model": model, "strategy": config.strategy.limited(cap)})


def most_gaussians(config: Config, num_times: int) -> int | None:
    """How many Gaussians a run may end with by its limits; None: as many as it wants.

    Args:
        config: of a run.
        num_times: distinct times of training.

    Raises:
        DyngsError: a size that has no room for a scene.
    """
    limits = [config.budget.max_gaussians] if config.budget.max_gaussians is not None else []
    if config.budget.max_mb is not None and not isinstance(config.model, HumanModel):
        limits.append(room(config, num_times, config.budget.max_mb))
    return min(limits, default=None)


def room(config: Config, num_times: int, megabytes: float) -> int:
    """How many Gaussians a file of so many 1e6 bytes holds, stored as exactly as is usual.

    Raises:
        DyngsError: fewer than ``FEWEST``; says which size has room for them.
    """
    model, fixed = config.model, 0.0
    degree = 0 if isinstance(config.colour, NetworkColour) else model.sh_degree
    each = SHAPE_BYTES + HARMONIC_BYTES * 3 * (num_sh_terms(degree) - 1)
    if isinstance(model, DynamicModel) and num_times > 1:
        one, two = (_field_values(model.deform, num_times, count) for count in (1, 2))
        fixed, each = FIELD_BYTES * (2 * one - two), each + FIELD_BYTES * (two - one)
    found = int((1e6 * megabytes - fixed) / each)
    if found < FEWEST:
        field = f", of which the field takes {1e-6 * fixed:.2g}" if fixed else ""
        raise DyngsError(
            f"budget.max_mb={megabytes:g}: has no room for {FEWEST} Gaussians; "
            f"{1e-6 * (fixed + FEWEST * each) * 1.05:.2g} would do{field}"
        )
    return found


def _field_values(options: DeformField, num_times: int, num_moving: int) -> int:
    """Numbers that a field learns."""
    setup = FieldSetup(torch.zeros(3), torch.ones(3), num_times, num_moving, 1.0)
    return new_field(options, setup, torch.Generator()).learned.num_values
