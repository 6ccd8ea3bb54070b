"""How exactly each attribute must be stored so that the pictures change by no more than is allowed.

Rounding with step s adds an error of about c s^2 to the pictures and costs -log2 s bits per value. The sum of errors is
given, the sum of bits is to be least: then every group of tensors may add errors in proportion to its number of values
(the water-filling of rate-distortion theory). Which step does that is measured, on pictures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.storage.drawable import completed, drawable
from dyngs.storage.quantize import LIMIT, step_below
from dyngs.storage.tensors import COARSENESS, MAX_COARSENESS, checked_coarseness, coding_of, group_of, restored

GREY_LEVELS = 255.0
TRIALS = 4
"""Steps that are tried for a group."""
CLOSE = 0.8
"""An error of so large a share of what is allowed is not brought closer to it."""
FIRST_STEP = 2.0**-6
"""Of the mean size of the values."""
WIDEST_JUMP = 32.0
MOST_VISIBLE = 0.9
"""Share of the Gaussians that show less than those that are stored most finely."""
ASSUMED_STEPS = {"quats": 2**-8, "log_scales": 2**-6, "logit_opacities": 2**-10, "sh_base": 2**-7, "sh_rest": 2**-7}

Draw = Callable[[Mapping[str, Tensor]], Sequence[Tensor]]
"""Pictures (H, W, 3), always from the same cameras at the same times, of a checkpoint's tensors."""


@dataclass(frozen=True)
class Precision:
    """Steps, and what they do.

    Attributes:
        steps: of each group of tensors.
        change: root mean square change of the pictures, grey levels of 255; None where none could be drawn.
    """

    steps: dict[str, float]
    change: float | None = None


def coarseness_of(visibility: Tensor) -> Tensor:
    """(N,) uint8, by how many octaves each Gaussian may be stored more coarsely than those that show most.

    An error of a Gaussian counts with the square of its weight in the pictures: half an octave per octave.

    Args:
        visibility: (N,) sums of its blending weights over pictures.
    """
    if not len(visibility):
        return torch.zeros(0, dtype=torch.uint8)
    most = torch.quantile(visibility[:: max(len(visibility) // 2**20, 1)].double(), MOST_VISIBLE).clamp_min(1e-30)
    octaves = -0.5 * (visibility.double() / most).clamp(1e-30, 1.0).log2()
    return octaves.round().clamp_max(MAX_COARSENESS).to(torch.uint8)


def assumed_precision(tensors: Mapping[str, Tensor]) -> Precision:
    """Steps where no picture can be drawn: fine ones, positions by the size of the Gaussians; all else is halves.

    Args:
        tensors: of a checkpoint.
    """
    log_scales = tensors["gaussians.log_scales"].double()
    size = float(log_scales.median(1).values.median().exp()) if len(log_scales) else 1.0
    return Precision(
        {f"gaussians.{name}": step for name, step in ASSUMED_STEPS.items()} | {"gaussians.means": size / 64}
    )


def measured_precision(tensors: Mapping[str, Tensor], draw: Draw, max_change: float) -> Precision:
    """The largest steps found that change the pictures by at most ``max_change``.

    Args:
        tensors: of a checkpoint.
        draw: the pictures that count.
        max_change: root mean square over all of their values, grey levels of 255, more than 0.

    Raises:
        DyngsError: a value is not finite.
    """
    exact = drawable(tensors)
    coarseness = checked_coarseness(exact[COARSENESS], len(exact["gaussians.means"])) if COARSENESS in exact else None
    wanted = [x.clamp(0, 1) for x in draw(tensors)]

    def change(steps: Mapping[str, float]) -> float:
        """Mean square over all values, with the groups of ``steps`` quantised."""
        rounded = dict(exact)
        for name, x in exact.items():
            if group_of(name, x) in steps:
                coding = coding_of(name, x, steps, by_coarseness=coarseness is not None)
                rounded[name] = restored(x, coding, coarseness)
        drawn = draw(completed(rounded))
        total = sum(float((x.clamp(0, 1) - y).double().square().sum()) for x, y in zip(drawn, wanted, strict=True))
        return total / max(sum(x.numel() for x in wanted), 1)

    allowed = (max_change / GREY_LEVELS) ** 2
    groups = _groups(exact)
    num_values = sum(sum(x.numel() for x in group) for group in groups.values())
    steps = {}
    for name, group in groups.items():
        share = sum(x.numel() for x in group) / num_values
        steps[name] = _largest_step(lambda step, name=name: change({name: step}), group, allowed * share)
    return _scaled(steps, change, allowed)


def _scaled(steps: dict[str, float], change: Callable[[Mapping[str, float]], float], allowed: float) -> Precision:
    """All steps by one factor, so that together they change the pictures by what is allowed, or a little less."""
    best = None
    tried, found, factor = steps, math.inf, 1.0
    for trial in range(2 * TRIALS):
        tried = {name: step_below(factor * step) for name, step in steps.items()}
        found = change(tried)
        if found <= allowed and (best is None or found > best[1]):
            best = (tried, found)
        if best is not None and (trial >= TRIALS or found > CLOSE * allowed):
            break
        factor *= min(max(math.sqrt(0.95 * allowed / max(found, 1e-300)), 0.5), 2.0)
    kept, error = (tried, found) if best is None else best
    return Precision(kept, math.sqrt(error) * GREY_LEVELS)


def _largest_step(change: Callable[[float], float], group: Sequence[Tensor], allowed: float) -> float:
    """The largest step tried that changes the pictures by at most ``allowed``.

    The first one tried where these pictures do not depend on the group at all: others may.
    """
    size = max((float(x.abs().max()) for x in group if x.numel()), default=0.0)
    if size == 0:
        return 1.0
    count = sum(x.numel() for x in group)
    mean_square = sum(float(x.double().square().sum()) for x in group) / count
    finest, coarsest = 2 * size / LIMIT, 4 * size
    step = first = min(max(FIRST_STEP * math.sqrt(mean_square), finest), coarsest)
    best = finest
    for _ in range(TRIALS):
        step = step_below(min(max(step, finest), coarsest))
        found = change(step)
        if found <= allowed:
            best = max(best, step)
            if found > CLOSE**2 * allowed or step >= coarsest / 2:
                break
        step *= min(max(math.sqrt(0.9 * allowed / max(found, 1e-300)), 1 / WIDEST_JUMP), WIDEST_JUMP)
    return step_below(first) if best >= coarsest / 2 else best


def _groups(tensors: Mapping[str, Tensor]) -> dict[str, list[Tensor]]:
    """Name of a group to its tensors."""
    groups: dict[str, list[Tensor]] = {}
    for name, x in tensors.items():
        group = group_of(name, x)
        if group is not None and x.numel():
            groups.setdefault(group, []).append(x)
    return groups
