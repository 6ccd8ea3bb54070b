"""Limits on the number of Gaussians, and what limits together are possible (docs/budget.md).

A limit on the file's size is one on the number of Gaussians first: so few that they fit when stored
as exactly as is usual.
"""

from __future__ import annotations

import torch

from dyngs.baselines.triangles.keys import BgTriangleModel
from dyngs.config import Config, DeformField, DynamicModel
from dyngs.core.conventions import num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.deform.field import FieldSetup
from dyngs.deform.fields import new_field

# Fraction of the limit that is kept free for the random Gaussians with which motion begins
RANDOM_FRACTION = 0.1
SHAPE_BYTES, HARMONIC_BYTES, FIELD_BYTES = 16.0, 0.35, 1.0
"""Bytes per Gaussian, per value of its harmonics, per value of a field: a little more than in
docs/storage.md."""
FEWEST = 500  # Fewest Gaussians that a limit on the size must have room for


def require_possible(config: Config) -> None:
    """Raise DyngsError where limits or choices of ``config`` contradict it or each other."""
    if config.model.is_posed and config.camera.refine == "always":
        raise DyngsError(
            "camera.refine: cameras of people are not refined, their poses are; leave it out"
        )
    _require_whole_images(config)
    if config.camera.refine == "always" and not config.model.made_of_gaussians:
        raise DyngsError(
            f"camera.refine=always: model.kind={config.model.kind} refines no cameras; leave it out"
        )
    _require_batch(config)
    budget = config.budget
    given = [name for name, value in budget.model_dump().items() if value is not None]
    is_triangles = isinstance(config.model, BgTriangleModel)
    given = [name for name in given if not (is_triangles and name == "max_mb")]
    if given and not config.model.made_of_gaussians:
        kind = config.model.kind
        instead = "give model.max_triangles" if is_triangles else "leave it out"
        raise DyngsError(
            f"budget.{given[0]}: model.kind={kind} has no Gaussians that could be limited; {instead}"
        )
    if config.train.minutes is not None and config.model.is_network:
        raise DyngsError(
            f"train.minutes: model.kind={config.model.kind} is trained for train.steps; leave it out"
        )
    if config.train.minutes is not None and config.prune.is_wanted:
        raise DyngsError(
            "train.minutes: how long the stage of prune.* takes cannot be foreseen; leave that out and run "
            "`dyngs prune` afterwards"
        )


def _require_whole_images(config: Config) -> None:
    """Raise where something is asked for that looks at whole images of a model that draws some of
    their pixels."""
    if config.model.draws_whole_images:
        return
    for key, value in _of_single_images(config).items():
        if value == "always":
            raise DyngsError(
                f"{key}=always: model.kind={config.model.kind} draws no whole images; leave it out"
            )


def _of_single_images(config: Config) -> dict[str, str]:
    """Return the choices that follow single images, by their keys."""
    train = config.train
    return {
        "train.robust": train.robust,
        "train.exposure": train.exposure,
        "camera.refine": config.camera.refine,
    }


def _require_batch(config: Config) -> None:
    """Raise where several views per step are asked for, and something that follows single
    images."""
    if config.train.batch_size == 1:
        return
    asked = f"train.batch_size={config.train.batch_size}"
    if config.model.is_network:
        raise DyngsError(
            f"{asked}: a network is trained on one person per step, by one process; leave it out"
        )
    for key, value in _of_single_images(config).items():
        if value != "never":
            raise DyngsError(
                f"{asked}: {key}={value} follows one image per step; give {key}=never, or one process"
            )


def within_cap(config: Config, cap: int | None) -> Config:
    """Return ``config`` with all numbers of Gaussians lowered to ``cap``; None: as it is."""
    changes = {}
    if cap is None:
        return config
    added = config.model.added_for_motion
    if added:
        added = min(added, int(RANDOM_FRACTION * cap))
        changes["model"] = config.model.model_copy(update={"num_random_moving": added})
    cap -= added
    return config.model_copy(update=changes | {"strategy": config.strategy.limited(cap)})


def most_gaussians(config: Config, num_times: int) -> int | None:
    """Return the largest number of Gaussians at the end by the limits of the run; None without
    one."""
    limits = [config.budget.max_gaussians] if config.budget.max_gaussians is not None else []
    if (
        config.budget.max_mb is not None
        and config.model.made_of_gaussians
        and not config.model.is_posed
    ):
        limits.append(room(config, num_times, config.budget.max_mb))
    return min(limits, default=None)


def room(config: Config, num_times: int, megabytes: float) -> int:
    """Return the number of Gaussians that fit in a file of so many 1e6 bytes at the usual
    precision.

    Raises:
        DyngsError: fewer than ``FEWEST``; says which size has room for them.
    """
    fixed = 0.0
    moves_by = config.model.deform if isinstance(config.model, DynamicModel) else None
    each = SHAPE_BYTES + HARMONIC_BYTES * 3 * (num_sh_terms(config.stored_sh_degree) - 1)
    if moves_by is not None and num_times > 1:
        fixed, whole = (
            FIELD_BYTES * num_field_values(moves_by, num_times, moving) for moving in (0, 1)
        )
        each += whole - fixed  # if all move
    found = int((1e6 * megabytes - fixed) / each)
    if found < FEWEST:
        field = f", of which the field takes {1e-6 * fixed:.2g}" if fixed else ""
        raise DyngsError(
            f"budget.max_mb={megabytes:g}: has no room for {FEWEST} Gaussians; "
            f"{1e-6 * (fixed + FEWEST * each) * 1.05:.2g} would do{field}"
        )
    return found


def num_field_values(options: DeformField, num_times: int, num_moving: int = 0) -> int:
    """Return the number of values that a field learns for so many Gaussians that move."""
    setup = FieldSetup(
        torch.zeros(3, device="cpu"), torch.ones(3, device="cpu"), num_times, num_moving, 1.0
    )
    return new_field(options, setup, torch.Generator()).parameters.num_values
