"""Choice of the Gaussians that keep harmonics: those whose view dependence improves images not
trained on.

Without its harmonics a Gaussian has the mean m of the colours that it shows in the training views,
each weighted with how much of it is seen there. How much that changes its colours there, sum_v w_v
|c_v - m|^2, ranks the Gaussians.

What the harmonics of each are worth is measured on other views: with a_i between 0 (mean) and 1
(harmonics) for Gaussian i the squared error E is quadratic in a, so that -dE/da_i at a = 1/2 for
all sums up over i to exactly the difference between none and all (the Aumann-Shapley value). The
first of the ranking that are worth nearly all that can be had are kept. As ranking and worth come
from different images, nothing is kept by chance.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, contributions, render
from dyngs.ops.harmonics import evaluate_harmonics

_LIFT = 64.0  # Added to colours so that none is clamped; float32 keeps 4e-6 of them


@dataclass(frozen=True)
class MeasuredView:
    """One training image and the N Gaussians that are drawn for it."""

    gaussians: Gaussians  # at its time
    camera: Cameras
    truth: Tensor  # (H, W, 3) on the background
    mask: Tensor | None


@dataclass(frozen=True)
class ViewDependence:
    """The Gaussians whose view dependence is worth its cost."""

    keeps: Tensor  # (N,) bool, Gaussians whose harmonics stay
    offsets: Tensor  # (N, 3) colour to add to the base of the others
    # worth_all, worth_kept: dB on the held-out views that the harmonics of all, of the kept ones
    # bring
    worth_all: float
    worth_kept: float

    def __str__(self) -> str:
        fraction = float(self.keeps.float().mean()) if len(self.keeps) else 0.0
        if fraction == 0:
            return f"view dependence does not pay ({self.worth_all:+.2f} dB on held-out training views): none is stored"
        return (
            f"view dependence pays for {fraction:.0%} of the Gaussians: {self.worth_kept:+.2f} dB on held-out training "
            f"views (for all of them: {self.worth_all:+.2f} dB)"
        )


def find_view_dependent(
    seen: Iterable[MeasuredView],
    held_out: Sequence[MeasuredView],
    options: RenderOptions,
    background: Tensor,
    tolerance: float,
) -> ViewDependence:
    """Return the Gaussians whose harmonics are worth their cost, and the colours of the others."""
    means, changes = _mean_and_change(seen, options)
    errors = []
    worths = torch.zeros(len(changes), device=changes.device)
    everywhere = torch.ones(len(changes), device=changes.device)
    nowhere = torch.zeros(len(changes), device=changes.device)
    for view in held_out:
        errors.append(
            [
                _squared_error(view, means, x, options, background).item()
                for x in (nowhere, everywhere)
            ]
        )
        half = torch.full((len(changes),), 0.5, requires_grad=True, device=changes.device)
        (slope,) = torch.autograd.grad(_squared_error(view, means, half, options, background), half)
        worths -= slope
    without, with_all = (math.fsum(column) for column in zip(*errors, strict=True))
    keeps = first_worthwhile(changes, worths, without, tolerance)
    kept = math.fsum(
        _squared_error(x, means, keeps.float(), options, background).item() for x in held_out
    )
    return ViewDependence(keeps, means, _decibels(without, with_all), _decibels(without, kept))


def first_worthwhile(changes: Tensor, worths: Tensor, without: float, tolerance: float) -> Tensor:
    """Return (N,) bool, the fewest rows, by descending ``changes``, that bring all but
    ``tolerance`` of the gain.

    Args:
        tolerance: dB by which the error may be above the lowest along the ranking; none is chosen
            if that suffices.
    """
    order = changes.argsort(descending=True, stable=True)
    errors = without - torch.cat(
        [torch.zeros(1, device=worths.device), worths[order].double().cumsum(0)]
    )
    enough = errors <= errors.clamp_min(1e-12).min() * 10 ** (tolerance / 10)
    keeps = torch.zeros(len(changes), dtype=torch.bool, device=changes.device)
    keeps[order[: int(enough.int().argmax())]] = True
    return keeps


def _mean_and_change(seen: Iterable[MeasuredView], options: RenderOptions) -> tuple[Tensor, Tensor]:
    """Return (N, 3) mean of what the harmonics add to the base colour in the views, and (N,) how
    much that varies."""
    # scalars may be added to what lies on any device
    weight = total = squares = torch.zeros((), device="cpu")
    for view in seen:
        fraction = contributions(view.gaussians, view.camera, options)[0]
        added = _added(view.gaussians, view.camera, fraction, options)
        weight = weight + fraction[:, None]
        total = total + fraction[:, None] * added
        squares = squares + fraction * added.square().sum(1)
    means = total / weight.clamp_min(1e-12)
    return means, (squares - weight[:, 0] * means.square().sum(1)).clamp_min(0)


def _added(
    gaussians: Gaussians, camera: Cameras, fraction: Tensor, options: RenderOptions
) -> Tensor:
    """Return (N, 3) what the harmonics beyond the constant add to the colours; 0 where nothing is
    seen."""
    lifted = gaussians.sh.clone()
    lifted[:, 0] = _LIFT / SH_C0
    degree = (
        gaussians.sh_degree
        if options.sh_degree is None
        else min(options.sh_degree, gaussians.sh_degree)
    )
    radii = (fraction > 0).int()[None, :, None].expand(1, -1, 2).contiguous()
    colors = evaluate_harmonics(gaussians.means, camera.centers, lifted, radii, degree)[0]
    return torch.where(fraction[:, None] > 0, colors - _LIFT - 0.5, 0.0)


def _squared_error(
    view: MeasuredView, means: Tensor, fractions: Tensor, options: RenderOptions, background: Tensor
) -> Tensor:
    """Return the squared error with the share ``shares[i]`` of the harmonics of Gaussian i;
    differentiable in these."""
    base = view.gaussians.sh[:, 0] + (1 - fractions)[:, None] * means / SH_C0
    rest = fractions[:, None, None] * view.gaussians.sh[:, 1:]
    mixed = view.gaussians.replace(sh=torch.cat([base[:, None], rest], dim=1))
    error = (
        render(mixed, view.camera, options, background=background).rgb[0] - view.truth
    ).square()
    return error.sum() if view.mask is None else (error * view.mask[..., None]).sum()


def _decibels(before: float, after: float) -> float:
    return 10 * math.log10(max(before, 1e-12) / max(after, 1e-12))
