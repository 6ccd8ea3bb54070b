"""Limits on the number of Gaussians, and checks of limits against each other.

A limit on the file size is first converted to a number of Gaussians, at the usual precision of
storage.
"""

from __future__ import annotations

from dyngs.config import Config, DefaultStrategy, SceneInit
from dyngs.core.conventions import num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.core.section import Section
from dyngs.data.capture import Capture
from dyngs.data.read import view_size
from dyngs.models.kind import HasGaussians, HasSizeLimit, capability, find_kind

# Fraction of the limit reserved for the random Gaussians that are added when motion begins
RANDOM_FRACTION = 0.1
# Bytes per Gaussian, per SH coefficient, per value of a deformation field: slightly more than
# measured.
SHAPE_BYTES, HARMONIC_BYTES, FIELD_BYTES = 16.0, 0.35, 1.0
SMALLEST_CAP, PER_ROOT_PIXEL = 100_000, 400
"""The number of Gaussians is capped at the second, times the square root of the number of training
pixels. Densification reached 30 to 155 times the root in all captures of the benchmarks, of 0.4
to 43 megapixels; the cap of 3,000,000 is the lower one from 56 megapixels on."""
FEWEST = 500  # Smallest number of Gaussians that a size limit must allow


def validate_limits(config: Config) -> None:
    """Raise DyngsError if limits or options of ``config`` contradict each other or its kind."""
    uses = find_kind(config.model).uses
    for key, value in _kind_specific_options(config).items():
        if key not in uses:
            raise DyngsError(
                f"{key}={value}: not supported by model.kind={config.model.kind}; remove it"
            )
    if config.train.batch_size > 1:
        for key, value in _single_image_options(config).items():
            if value != "never":
                raise DyngsError(
                    f"train.batch_size={config.train.batch_size}: {key}={value} needs one image "
                    "per step; use "
                    f"{key}=never, or train.batch_size=1"
                )
    if config.train.minutes is not None and config.prune.is_enabled:
        raise DyngsError(
            "train.minutes: cannot be combined with prune.*, whose duration is unknown; train "
            "first, then run "
            "`dyngs prune`"
        )


# Keys of sections that only some model kinds support; None: all keys.
_KIND_SPECIFIC = {
    "budget": None,
    "prune": None,
    "data": {"person", "stature"},
    "train": {"minutes", "image_every", "batch_size"},
}
_PRUNING_DETAILS = {"steps", "score", "signed", "mask_between"}


def _kind_specific_options(config: Config) -> dict[str, object]:
    """Return the options, by key, that are set and that only some model kinds support."""
    given: dict[str, object] = {
        key: x for key, x in _single_image_options(config).items() if x == "always"
    }
    for name, keys in _KIND_SPECIFIC.items():
        section: Section = getattr(config, name)
        changed = section.model_dump(exclude_defaults=True, include=keys, exclude=_PRUNING_DETAILS)
        given |= {f"{name}.{key}": value for key, value in changed.items()}
    return given


def _single_image_options(config: Config) -> dict[str, str]:
    """Return the options, by key, that need one image per step."""
    train = config.train
    return {
        "train.robust": train.robust,
        "train.exposure": train.exposure,
        "camera.refine": config.camera.refine,
    }


def apply_gaussian_cap(config: Config, cap: int | None) -> Config:
    """Return ``config`` with all limits on Gaussians lowered to ``cap``. None changes nothing."""
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


def apply_pixel_cap(config: Config, capture: Capture) -> Config:
    """Return ``config`` with ``strategy.max_gaussians`` limited by the number of training pixels.

    A requested limit and runs that continue a scene are left unchanged.
    """
    strategy = config.strategy
    grows = isinstance(strategy, DefaultStrategy) and strategy.grow
    is_requested = "max_gaussians" in strategy.model_fields_set
    if not grows or is_requested or isinstance(config.init, SceneInit):
        return config
    sizes = (view_size(view, config.data) for view in capture.splits["train"])
    pixels = sum(width * height for width, height in sizes)
    points = 0 if capture.points is None else len(capture.points.xyz)
    cap = max(SMALLEST_CAP, round(PER_ROOT_PIXEL * pixels**0.5), 2 * points)
    return config.model_copy(update={"strategy": strategy.limited(cap)})


def gaussian_limit(config: Config, num_times: int) -> int | None:
    """Return the largest allowed number of Gaussians at the end of a run, or None."""
    limits = [config.budget.max_gaussians] if config.budget.max_gaussians is not None else []
    megabytes = config.budget.max_mb
    if megabytes is not None and capability(config.model, HasSizeLimit) is not None:
        limits.append(max_gaussians_in_file(config, num_times, megabytes))
    return min(limits, default=None)


def max_gaussians_in_file(config: Config, num_times: int, megabytes: float) -> int:
    """Return the number of Gaussians that fit into a file of ``megabytes`` (1e6 bytes) at the usual
    precision.

    Raises:
        DyngsError: fewer than ``FEWEST`` fit. The message contains the size that would suffice.
    """
    each = SHAPE_BYTES + HARMONIC_BYTES * 3 * (num_sh_terms(config.stored_sh_degree) - 1)
    kind = capability(config.model, HasSizeLimit)
    assert kind is not None
    static_bytes, bytes_per_moving_gaussian = (
        FIELD_BYTES * kind.num_shared(config.model, num_times, moving) for moving in (0, 1)
    )
    each += bytes_per_moving_gaussian - static_bytes  # all Gaussians may move
    count = int((1e6 * megabytes - static_bytes) / each)
    if count < FEWEST:
        field = f" (deformation field: {1e-6 * static_bytes:.2g} MB)" if static_bytes else ""
        raise DyngsError(
            f"budget.max_mb={megabytes:g}: too small for {FEWEST} Gaussians; use "
            f"{1e-6 * (static_bytes + FEWEST * each) * 1.05:.2g} or more{field}"
        )
    return count
