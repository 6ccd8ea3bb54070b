"""Precision of each attribute at which the images change by no more than is allowed.

Rounding with step s adds an error of about c s^2 to the images and costs -log2 s bits per value.
The sum of errors is given, the sum of bits is to be least: then every group of tensors may add
errors in proportion to its number of values (the water-filling of rate-distortion theory). Which
step does that is measured, on images.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.gaussians import Gaussians
from dyngs.runs.stored_tensors import (
    COARSENESS,
    LIMIT,
    MAX_COARSENESS,
    checked_coarseness,
    coding_of,
    completed,
    group_of,
    restored,
    step_below,
)

GREY_LEVELS = 255.0
TRIALS = 4  # number of steps tried per group
CLOSE = 0.8  # fraction of the allowed error from which the search ends
FIRST_STEP = 2.0**-6  # first step as a fraction of the mean magnitude of the values
WIDEST_JUMP = 32.0
OUTLYING, USUAL_FRACTION = 64.0, 0.95
"""Values so many times as large as this fraction of those that are not 0 are outliers: steps are
chosen without them."""
MOST_VISIBLE = 0.9  # quantile of visibility above which Gaussians are stored most finely
ASSUMED_STEPS = {
    "quats": 2**-8,
    "log_scales": 2**-6,
    "logit_opacities": 2**-10,
    "sh_base": 2**-7,
    "sh_rest": 2**-7,
}

Draw = Callable[[Mapping[str, Tensor]], Sequence[Tensor]]
"""Images (H, W, 3), always from the same cameras at the same times, of a checkpoint's tensors."""


@dataclass(frozen=True)
class Precision:
    """Quantisation steps and the change of images that they cause."""

    steps: dict[str, float]  # of each group of tensors; 0: it is stored as it is
    # root mean square change of the images, grey levels of 255; None where none could be drawn
    change: float | None = None
    allowed: float | None = None  # what it was to be at most; None likewise


def coarseness_of(visibility: Tensor) -> Tensor:
    """Return (N,) uint8 octaves by which each Gaussian may be stored more coarsely than the most
    visible ones.

    An error of a Gaussian counts with the square of its weight in the images: half an octave per
    octave. ``visibility``: (N,) sums of its blending weights over images.
    """
    if not len(visibility):
        return torch.zeros(0, dtype=torch.uint8, device=visibility.device)
    most = torch.quantile(
        visibility[:: max(len(visibility) // 2**20, 1)].double(), MOST_VISIBLE
    ).clamp_min(1e-30)
    octaves = -0.5 * (visibility.double() / most).clamp(1e-30, 1.0).log2()
    return octaves.round().clamp_max(MAX_COARSENESS).to(torch.uint8)


def assumed_precision(gaussians: Gaussians) -> Precision:
    """Return steps where no image can be drawn: fine ones; those of positions follow the size of
    the Gaussians."""
    log_scales = gaussians.log_scales.detach().double()
    size = float(log_scales.median(1).values.median().exp()) if len(log_scales) else 1.0
    return Precision(
        {f"gaussians.{name}": step for name, step in ASSUMED_STEPS.items()}
        | {"gaussians.means": size / 64}
    )


def measured_precision(
    exact: Mapping[str, Tensor], wanted: Sequence[Tensor], draw: Draw, max_change: float
) -> Precision:
    """Return the largest steps found that change the images by at most ``max_change``, grey levels
    of 255.

    ``exact``: from ``drawable``, with the coarseness of the Gaussians if they have any; ``draw``
    draws its like anew. Raises DyngsError: a value is not finite.
    """

    def change(steps: Mapping[str, float], names: Iterable[str] = exact) -> float:
        """Return the mean square over all values, with the tensors of these names quantised."""
        return mean_square_change(wanted, draw(completed(rounded(exact, steps, names))))

    allowed = (max_change / GREY_LEVELS) ** 2
    groups: dict[str, dict[str, Tensor]] = {}
    for name, x in exact.items():
        group = group_of(name, x)
        if group is not None and x.numel():
            groups.setdefault(group, {})[name] = x
    num_values = sum(sum(x.numel() for x in group.values()) for group in groups.values())
    steps = {}
    too_coarse = {}
    for name, group in groups.items():
        fraction = sum(x.numel() for x in group.values()) / num_values
        steps[name], is_enough = _largest_step(
            lambda step, name=name, group=group: change({name: step}, group),
            list(group.values()),
            allowed * fraction,
        )
        too_coarse |= {} if is_enough else {name: 0.0}
    kept, found = _scaled(steps, change, allowed)
    if not found <= allowed:
        kept, found = _scaled(steps | too_coarse, change, allowed)
    if not found <= allowed:
        kept = dict.fromkeys((*groups, *exact), 0.0)
        found = change(kept)
    return Precision(kept, math.sqrt(found) * GREY_LEVELS, max_change)


def rounded(
    exact: Mapping[str, Tensor], steps: Mapping[str, float], names: Iterable[str] | None = None
) -> dict[str, Tensor]:
    """Return the tensors with those of ``names`` (None: all) as a file with these steps holds them.

    ``exact``: from ``drawable``, and the coarseness of the Gaussians if they have any. ``names``:
    of the tensors that are rounded.
    """
    coarseness = (
        checked_coarseness(exact[COARSENESS], len(exact["gaussians.means"]))
        if COARSENESS in exact
        else None
    )
    found = dict(exact)
    for name in exact if names is None else names:
        coding = coding_of(name, exact[name], steps, by_coarseness=coarseness is not None)
        found[name] = restored(exact[name], coding, coarseness)
    return found


def mean_square_change(before: Sequence[Tensor], after: Sequence[Tensor]) -> float:
    """Return the mean square over all values of images in [0, 1], after clamping; NaN where one of
    them is."""
    total = sum(
        float((x.clamp(0, 1) - y.clamp(0, 1)).double().square().sum())
        for x, y in zip(before, after, strict=True)
    )
    return total / max(sum(x.numel() for x in before), 1)


def _scaled(
    steps: dict[str, float], change: Callable[[Mapping[str, float]], float], allowed: float
) -> tuple[dict[str, float], float]:
    """Return all steps times one factor, so that together they change the images by what is allowed
    or less.

    And the mean square change that they make, which is larger only where no factor that was tried
    is small enough.
    """
    best = None
    tried = steps
    found = math.inf
    factor = 1.0
    for trial in range(2 * TRIALS):
        tried = {name: step and step_below(factor * step) for name, step in steps.items()}
        found = change(tried)
        if found <= allowed and (best is None or found > best[1]):
            best = (tried, found)
        if best is not None and (trial >= TRIALS or found > CLOSE * allowed):
            break
        if math.isnan(found):
            break
        factor *= min(max(math.sqrt(0.95 * allowed / max(found, 1e-300)), 0.5), 2.0)
    return (tried, found) if best is None else best


def _largest_step(
    change: Callable[[float], float], group: Sequence[Tensor], allowed: float
) -> tuple[float, bool]:
    """Return the largest step tried that changes images by at most ``allowed``, else the finest;
    and whether it does.

    The first one tried where these images do not depend on the group at all: others may.
    """
    size, mean_square = _usual_size(torch.cat([x.flatten() for x in group]))
    if size == 0:
        return 1.0, True
    finest = 2 * size / LIMIT
    coarsest = 4 * size
    step = first = min(max(FIRST_STEP * math.sqrt(mean_square), finest), coarsest)
    best = None
    for _ in range(TRIALS):
        step = step_below(min(max(step, finest), coarsest))
        found = change(step)
        if math.isnan(found):
            return finest, False
        if found <= allowed:
            best = max(best or 0.0, step)
            if found > CLOSE**2 * allowed or step >= coarsest / 2:
                break
        step *= min(
            max(math.sqrt(0.9 * allowed / max(found, 1e-300)), 1 / WIDEST_JUMP), WIDEST_JUMP
        )
    if best is None:
        return finest, change(step_below(finest)) <= allowed
    return step_below(first) if best >= coarsest / 2 else best, True


def _usual_size(values: Tensor) -> tuple[float, float]:
    """Return the largest of the values without outliers, and the mean of their squares."""
    sizes = values.abs().double()
    nonzero = sizes[sizes > 0]
    if not len(nonzero):
        return 0.0, 0.0
    usual = nonzero.kthvalue(max(int(USUAL_FRACTION * len(nonzero)), 1)).values
    sizes = sizes[sizes <= OUTLYING * usual]
    return float(sizes.max()), float(sizes.square().mean())
