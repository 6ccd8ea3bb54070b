"""Limits on the number of Gaussians and their combinations; see docs/reference/limits.md.

A limit on the file's size is one on the number of Gaussians first: so few that they fit when stored
as exactly as is usual.
"""

from __future__ import annotations

from dyngs.config import Config
from dyngs.core.conventions import num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.models.kind import HasGaussians, HasSizeLimit, capability, find_kind

# Fraction of the limit that is kept free for the random Gaussians with which motion begins
RANDOM_FRACTION = 0.1
SHAPE_BYTES, HARMONIC_BYTES, FIELD_BYTES = 16.0, 0.35, 1.0
"""Bytes per Gaussian, per value of its harmonics, per value of a field: a little more than in
docs/reference/formats.md."""
FEWEST = 500  # Fewest Gaussians that a limit on the size must have room for


def validate_limits(config: Config) -> None:
    """Raise DyngsError where limits or choices of ``config`` contradict it or each other."""
    uses = find_kind(config.model).uses
    for key, value in _given(config).items():
        if key not in uses:
            raise DyngsError(
                f"{key}={value}: has no effect with model.kind={config.model.kind}; leave it out"
            )
    if config.train.batch_size > 1:
        for key, value in _of_single_images(config).items():
            if value != "never":
                raise DyngsError(
                    f"train.batch_size={config.train.batch_size}: {key}={value} follows one image per step; give "
                    f"{key}=never, or one process"
                )
    if config.train.minutes is not None and config.prune.is_enabled:
        raise DyngsError(
            "train.minutes: how long the stage of prune.* takes cannot be foreseen; leave that out and run "
            "`dyngs prune` afterwards"
        )


def _given(config: Config) -> dict[str, object]:
    """Return what is requested that only some kinds of model use, by its key."""
    found: dict[str, object] = {
        key: x for key, x in _of_single_images(config).items() if x == "always"
    }
    for name, section in (("budget", config.budget), ("prune", config.prune)):
        given = section.model_dump(exclude_defaults=True, exclude={"steps", "score"})
        found |= {f"{name}.{key}": value for key, value in given.items()}
    if config.train.minutes is not None:
        found["train.minutes"] = config.train.minutes
    if config.train.batch_size > 1:
        found["train.batch_size"] = config.train.batch_size
    return found


def _of_single_images(config: Config) -> dict[str, str]:
    """Return the choices that follow single images, by their keys."""
    train = config.train
    return {
        "train.robust": train.robust,
        "train.exposure": train.exposure,
        "camera.refine": config.camera.refine,
    }


def apply_gaussian_cap(config: Config, cap: int | None) -> Config:
    """Return ``config`` with all numbers of Gaussians lowered to ``cap``; None: as it is."""
    changes = {}
    if cap is None:
        return config
    added = config.model.num_added_for_motion
    made_of = capability(config.model, HasGaussians)
    if made_of is not None and added:
        added = min(added, int(RANDOM_FRACTION * cap))
        changes["model"] = made_of.with_added_gaussians(config.model, added)
    cap -= added
    return config.model_copy(update=changes | {"strategy": config.strategy.limited(cap)})


def gaussian_limit(config: Config, num_times: int) -> int | None:
    """Return the largest number of Gaussians at the end by the limits of the run; None without
    one."""
    limits = [config.budget.max_gaussians] if config.budget.max_gaussians is not None else []
    megabytes = config.budget.max_mb
    if megabytes is not None and capability(config.model, HasSizeLimit) is not None:
        limits.append(max_gaussians_in_file(config, num_times, megabytes))
    return min(limits, default=None)


def max_gaussians_in_file(config: Config, num_times: int, megabytes: float) -> int:
    """Return the number of Gaussians that fit in a file of so many 1e6 bytes at the usual
    precision.

    Raises:
        DyngsError: fewer than ``FEWEST``; says which size has room for them.
    """
    each = SHAPE_BYTES + HARMONIC_BYTES * 3 * (num_sh_terms(config.stored_sh_degree) - 1)
    kind = capability(config.model, HasSizeLimit)
    assert kind is not None
    fixed, whole = (
        FIELD_BYTES * kind.num_shared(config.model, num_times, moving) for moving in (0, 1)
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
