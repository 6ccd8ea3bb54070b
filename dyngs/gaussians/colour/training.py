"""Training of colours, one class per ``colour.kind``, and selection of Gaussians that keep SH."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from dyngs.config import AutoColour, ColourSection, NetworkColour
from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0
from dyngs.core.initialisation import glorot_layers
from dyngs.core.state import Role, State, StateTensor
from dyngs.core.tensor_checks import require_tensor
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.colour.network import ColourNetwork
from dyngs.gaussians.optimizer import Parameters
from dyngs.gaussians.rendering import RenderOptions, contributions, render, shade
from dyngs.ops.adam import Count
from dyngs.ops.shading import num_inputs

_CLAMP_OFFSET = 64.0  # offset that keeps colours above the clamp at 0; float32 still resolves 4e-6


@dataclass(frozen=True)
class MeasuredView:
    """A training image and the N Gaussians at its time."""

    gaussians: Gaussians
    camera: Cameras
    truth: Tensor  # (H, W, 3) image on the background
    mask: Tensor | None


@dataclass(frozen=True)
class ViewDependence:
    """Gaussians whose view-dependent colour improves held-out views enough to be stored."""

    kept_harmonics: Tensor  # (N,) bool, Gaussians that keep their SH coefficients
    offsets: Tensor  # (N, 3) colour added to the base colour of the others
    # PSNR gain in dB on held-out training views with the SH of all, and of the selected Gaussians.
    gain_all: float
    gain_kept: float

    def __str__(self) -> str:
        fraction = float(self.kept_harmonics.float().mean()) if len(self.kept_harmonics) else 0.0
        if fraction == 0:
            return f"view-dependent colour removed: it changes held-out views by {self.gain_all:+.2f} dB"
        return (
            f"view-dependent colour kept for {fraction:.0%} of the Gaussians: {self.gain_kept:+.2f} dB "
            f"on held-out views ({self.gain_all:+.2f} dB with all)"
        )


def find_view_dependent(
    seen: Iterable[MeasuredView],
    held_out: Sequence[MeasuredView],
    options: RenderOptions,
    background: Tensor,
    tolerance: float,
) -> ViewDependence:
    """Select the Gaussians that keep their SH coefficients, and the base colours of the others.

    ``seen``: views that the mean view-dependent colour is measured on. ``held_out``: views that
    decide. ``tolerance``: PSNR in dB that may be given up, see ``select_worthwhile``.
    """
    means, changes = _view_dependence_statistics(seen, options)
    nowhere = torch.zeros_like(changes)

    def error(fractions: Tensor) -> float:
        return math.fsum(
            _squared_error(view, means, fractions, options, background).item() for view in held_out
        )

    worths = torch.zeros_like(changes)
    for view in held_out:
        half = torch.full_like(changes, 0.5, requires_grad=True)
        (slope,) = torch.autograd.grad(_squared_error(view, means, half, options, background), half)
        worths -= slope
    without = error(nowhere)
    kept_harmonics = select_worthwhile(changes, worths, without, tolerance)
    gain_all, gain_kept = (
        _psnr_gain(without, error(x)) for x in (nowhere + 1, kept_harmonics.float())
    )
    return ViewDependence(kept_harmonics, means, gain_all, gain_kept)


def select_worthwhile(changes: Tensor, worths: Tensor, without: float, tolerance: float) -> Tensor:
    """Select the fewest rows, ranked by ``changes``, that keep the gain within ``tolerance``.

    Args:
        changes: (N,) variation of the view-dependent colour; larger ones are selected first.
        worths: (N,) predicted reduction of the squared error by each row.
        without: squared error with no row selected.
        tolerance: dB by which the error may exceed the lowest error along the ranking.

    Returns:
        (N,) bool.
    """
    order = changes.argsort(descending=True, stable=True)
    errors = without - torch.cat(
        [torch.zeros(1, device=worths.device), worths[order].double().cumsum(0)]
    )
    enough = errors <= errors.clamp_min(1e-12).min() * 10 ** (tolerance / 10)
    kept_harmonics = torch.zeros(len(changes), dtype=torch.bool, device=changes.device)
    kept_harmonics[order[: int(enough.int().argmax())]] = True
    return kept_harmonics


def _view_dependence_statistics(
    seen: Iterable[MeasuredView], options: RenderOptions
) -> tuple[Tensor, Tensor]:
    """Return the mean (N, 3) and the summed variance (N,) of the view-dependent colour over the
    views."""
    # 0-d CPU tensors can be added to tensors on any device
    weight = total = squares = torch.zeros((), device="cpu")
    for view in seen:
        fraction = contributions(view.gaussians, view.camera, options)[0]
        added = _view_dependent_colour(view.gaussians, view.camera, fraction, options)
        weight = weight + fraction[:, None]
        total = total + fraction[:, None] * added
        squares = squares + fraction * added.square().sum(1)
    means = total / weight.clamp_min(1e-12)
    return means, (squares - weight[:, 0] * means.square().sum(1)).clamp_min(0)


def _view_dependent_colour(
    gaussians: Gaussians, camera: Cameras, fraction: Tensor, options: RenderOptions
) -> Tensor:
    """Return the colour (N, 3) that SH above degree 0 add; 0 for Gaussians without contribution."""
    lifted = gaussians.sh.clone()
    lifted[:, 0] = _CLAMP_OFFSET / SH_C0
    radii = (fraction > 0).int()[None, :, None].expand(1, -1, 2).contiguous()
    colors = shade(gaussians.replace(sh=lifted), camera, radii, options)[0]
    return torch.where(fraction[:, None] > 0, colors - _CLAMP_OFFSET - 0.5, 0.0)


def _squared_error(
    view: MeasuredView, means: Tensor, fractions: Tensor, options: RenderOptions, background: Tensor
) -> Tensor:
    """Return the squared error with the SH of Gaussian i scaled by ``fractions[i]``;
    differentiable."""
    base = view.gaussians.sh[:, 0] + (1 - fractions)[:, None] * means / SH_C0
    rest = fractions[:, None, None] * view.gaussians.sh[:, 1:]
    mixed = view.gaussians.replace(sh=torch.cat([base[:, None], rest], dim=1))
    error = (
        render(mixed, view.camera, options, background=background).rgb[0] - view.truth
    ).square()
    return error.sum() if view.mask is None else (error * view.mask[..., None]).sum()


def _psnr_gain(before: float, after: float) -> float:
    return 10 * math.log10(max(before, 1e-12) / max(after, 1e-12))


WARM_UP = 100  # linear warm-up steps of the network's learning rate
_MILESTONES = (1 / 6, 1 / 2, 5 / 6)
"""Fractions of the run after which the network's learning rate is divided by 3 (MEGA)."""
HELD_OUT_EVERY = 8
_HELD_OUT = 5  # index of the held-out view among each eight


class ColourTraining:
    """Training of plain SH colours; base class of the other colour models.

    Attributes:
        parameters: of the colour network; None without one.
        measurement_step: step after which SH that do not improve the views ``held_out`` are
            dropped, see ``find_view_dependent``; 0: never.
        frozen_harmonics: (N,) bool, Gaussians whose SH above degree 0 stay zero; None: no Gaussian.
    """

    parameters: Parameters | None = None
    measurement_step = 0
    held_out: Sequence[int] = ()
    tolerance = 0.0
    frozen_harmonics: Tensor | None = None

    def __init__(self, options: ColourSection) -> None:
        self.entropy_weight = options.opacity_entropy

    @property
    def network(self) -> ColourNetwork | None:
        """Colour network, or None if SH coefficients give the colours."""
        return None

    def penalties(self, gaussians: Gaussians) -> dict[str, Tensor]:
        if self.entropy_weight == 0:
            return {}
        return {"opacity entropy": self.entropy_weight * opacity_entropy(gaussians.logit_opacities)}

    def is_held_out(self, index: int, step: int) -> bool:
        """Return whether training view ``index`` is held out at ``step``."""
        return step <= self.measurement_step and index in self.held_out

    def freeze(self, frozen: Tensor) -> None:
        """Keep the SH above degree 0 of the Gaussians ``frozen`` (N,) at zero from now on."""
        self.frozen_harmonics = None if bool(frozen.all()) else frozen

    def apply_edit(self, edit: TopologyEdit) -> None:
        """Update per-Gaussian state after a topology edit."""
        if self.frozen_harmonics is not None:
            self.frozen_harmonics = edit.apply(self.frozen_harmonics)

    def optimize(self, step: int) -> Count:
        """Update the colour parameters in place; return the number of skipped rows (bad
        gradients)."""
        return 0

    def move_to(self, device: torch.device) -> None:
        """Move the state to ``device``."""
        if self.frozen_harmonics is not None:
            self.frozen_harmonics = self.frozen_harmonics.to(device)

    def state(self) -> State:
        frozen = self.frozen_harmonics
        return {} if frozen is None else {"frozen": StateTensor(frozen, Role.TRAINING)}

    def restore(self, tensors: Mapping[str, Tensor], count: int) -> None:
        """Restore the state for N = ``count`` Gaussians."""
        frozen = tensors.get("frozen")
        if frozen is not None:
            require_tensor("frozen", frozen, (count,), torch.bool)
        self.frozen_harmonics = frozen


class NetworkTraining(ColourTraining):
    """A colour network shared by all Gaussians, trained with Adam."""

    parameters: Parameters

    def __init__(
        self,
        options: NetworkColour,
        steps: int,
        box: Tensor,
        generator: torch.Generator,
        *,
        uses_time: bool,
    ) -> None:
        super().__init__(options)
        self.options, self.steps, self.box, self.uses_time = options, steps, box, uses_time
        inputs = num_inputs(uses_time=uses_time, uses_normals=options.normals)
        widths = [inputs, *[options.width] * options.depth, 3]
        values = glorot_layers(pairwise(widths), generator)
        values[f"weight{options.depth}"].zero_()  # so that the colours start unchanged
        self.parameters = Parameters(values, dict.fromkeys(values, options.lr))

    @property
    def network(self) -> ColourNetwork:
        layers = self.parameters.layers(self.options.depth + 1)
        return ColourNetwork(tuple(layers), self.box, self.uses_time, self.options.normals)

    def optimize(self, step: int) -> Count:
        factor = rate_factor(step, self.steps)
        return self.parameters.update(step, dict.fromkeys(self.parameters.rates, factor))

    def move_to(self, device: torch.device) -> None:
        self.box, self.parameters = self.box.to(device), self.parameters.to(device)

    def state(self) -> State:
        return {name: x for name, x in self.parameters.state().items() if x.role is Role.TRAINING}

    def restore(self, tensors: Mapping[str, Tensor], count: int) -> None:
        self.box = require_tensor("box", tensors["box"], (2, 3), None)
        self.parameters = self.parameters.with_state(tensors)


class AutoTraining(ColourTraining):
    """SH for all Gaussians, later reduced to those where they improve held-out views."""

    def __init__(self, options: AutoColour, steps: int, num_views: int) -> None:
        super().__init__(options)
        self.tolerance = options.tolerance
        self.measurement_step = options.measurement_step(steps)
        self.held_out = range(_HELD_OUT, num_views, HELD_OUT_EVERY)


def opacity_entropy(logits: Tensor) -> Tensor:
    """Return the mean of -o ln o over opacities o = sigmoid(``logits``) (N,) (Zhang et al. 2024).

    The maximum is at o = 1/e: lower opacities are pushed towards 0, higher ones towards 1. The
    gradient by a logit, -(ln o + 1) o (1 - o), is finite everywhere. N may be 0.
    """
    if not len(logits):
        return logits.sum()
    return -(logits.sigmoid() * logsigmoid(logits)).mean()


def rate_factor(step: int, steps: int) -> float:
    """Return the learning rate factor at ``step``: linear warm-up, then a third after each
    milestone."""
    passed = sum(step > fraction * steps for fraction in _MILESTONES)
    return min(1.0, step / WARM_UP) / 3**passed
