"""Training of colours: one class per ``colour.kind``, and the choice of the Gaussians that keep harmonics."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from dyngs.config import AutoColour, ColourSection, NetworkColour
from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0
from dyngs.core.initialisation import glorot
from dyngs.core.state import Role, State, StateTensor
from dyngs.core.tensor_checks import require_tensor
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.colour.network import ColourNetwork
from dyngs.gaussians.optimizer import Parameters
from dyngs.gaussians.rendering import RenderOptions, contributions, render
from dyngs.ops.adam import Count
from dyngs.ops.harmonics import evaluate_harmonics
from dyngs.ops.perceptron import Layer
from dyngs.ops.shading import num_inputs

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

    kept_harmonics: Tensor  # (N,) bool, Gaussians whose harmonics stay
    offsets: Tensor  # (N, 3) colour to add to the base of the others
    # worth_all, worth_kept: dB on the held-out views that the harmonics of all, of the kept ones
    # bring
    gain_all: float
    gain_kept: float

    def __str__(self) -> str:
        fraction = float(self.kept_harmonics.float().mean()) if len(self.kept_harmonics) else 0.0
        if fraction == 0:
            return f"view dependence does not pay ({self.gain_all:+.2f} dB on held-out training views): none is stored"
        return (
            f"view dependence pays for {fraction:.0%} of the Gaussians: {self.gain_kept:+.2f} dB on held-out training "
            f"views (for all of them: {self.gain_all:+.2f} dB)"
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
    kept_harmonics = select_worthwhile(changes, worths, without, tolerance)
    kept = math.fsum(
        _squared_error(x, means, kept_harmonics.float(), options, background).item()
        for x in held_out
    )
    return ViewDependence(
        kept_harmonics, means, _decibels(without, with_all), _decibels(without, kept)
    )


def select_worthwhile(changes: Tensor, worths: Tensor, without: float, tolerance: float) -> Tensor:
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
    kept_harmonics = torch.zeros(len(changes), dtype=torch.bool, device=changes.device)
    kept_harmonics[order[: int(enough.int().argmax())]] = True
    return kept_harmonics


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


WARM_UP = 100  # Steps in which the network's rate is reached
_MILESTONES = (1 / 6, 1 / 2, 5 / 6)
"""Fractions of a run after which the network's rate is divided by 3 (MEGA: 5k, 15k and 25k of 30k
steps)."""
HELD_OUT_EVERY = 8
_HELD_OUT = 5  # Index, in each eight views, of the one that is held out


@dataclass(frozen=True)
class MeasurementViews:
    """The training views as the scene is drawn for them now."""

    indices: Sequence[int]  # of the views that may be trained on
    views: Callable[[Sequence[int]], Iterator[MeasuredView]]  # those of some indices, one at a time
    options: RenderOptions
    background: Tensor


class ColourTraining:
    """Harmonics as they are stored: nothing to learn next to them."""

    def __init__(self, options: ColourSection) -> None:
        self.entropy_weight = options.opacity_entropy

    @property
    def network(self) -> ColourNetwork | None:
        """The colour network; None where the harmonics give the colours."""
        return None

    @property
    def network_parameters(self) -> Parameters | None:
        return None

    def penalties(self, gaussians: Gaussians) -> dict[str, Tensor]:
        if self.entropy_weight == 0:
            return {}
        return {"opacity entropy": self.entropy_weight * opacity_entropy(gaussians.logit_opacities)}

    def is_held_out(self, index: int, step: int) -> bool:
        """Return whether training view ``index`` must not be trained on in ``step``."""
        return False

    def measure_harmonics(
        self, step: int, looks: Callable[[], MeasurementViews]
    ) -> ViewDependence | None:
        """Measure, if due after ``step``, whose harmonics improve images; the others are dropped."""
        return None

    def frozen_harmonics(self) -> Tensor | None:
        """Return (N,) bool, Gaussians whose harmonics stay zero but for the base colour; None: of
        none."""
        return None

    def follow(self, edit: TopologyEdit) -> None:
        """Follow a change of the set of Gaussians."""

    def optimize(self, step: int) -> Count:
        """Update what is learned next to the harmonics, and return the number of rows left out for
        bad gradients."""
        return 0

    def place(self, device: torch.device) -> None:
        """Go on on ``device``."""

    def state(self) -> State:
        return {}

    def restore(self, tensors: Mapping[str, Tensor], count: int) -> None:
        """Take over the state of the scene's colours and of ``state``, for N Gaussians."""


class NetworkTraining(ColourTraining):
    """A network that all Gaussians share, learned by Adam."""

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
        inputs = num_inputs(uses_time=uses_time, uses_normals=True)
        values = _start_values([inputs, *[options.width] * options.depth, 3], generator)
        self.parameters = Parameters(values, dict.fromkeys(values, options.lr))

    @property
    def network(self) -> ColourNetwork:
        count = self.options.depth + 1
        layers = (
            Layer(self.parameters[f"weight{i}"], self.parameters[f"bias{i}"]) for i in range(count)
        )
        return ColourNetwork(tuple(layers), self.box, self.uses_time, uses_normals=True)

    @property
    def network_parameters(self) -> Parameters:
        return self.parameters

    def optimize(self, step: int) -> Count:
        return self.parameters.update(step, rate_factor(step, self.steps))

    def place(self, device: torch.device) -> None:
        self.box, self.parameters = self.box.to(device), self.parameters.to(device)

    def state(self) -> State:
        return {name: x for name, x in self.parameters.state().items() if x.role is Role.TRAINING}

    def restore(self, tensors: Mapping[str, Tensor], count: int) -> None:
        self.box = require_tensor("box", tensors["box"], (2, 3), None)
        self.parameters = self.parameters.with_state(tensors)


class AutoTraining(ColourTraining):
    """Harmonics for all Gaussians at first, later only for those where they are measured to improve
    images."""

    def __init__(self, options: AutoColour, steps: int, num_views: int) -> None:
        super().__init__(options)
        self.tolerance = options.tolerance
        self.measurement_step = options.measurement_step(steps)
        self.held_out = tuple(range(_HELD_OUT, num_views, HELD_OUT_EVERY))
        self._frozen: Tensor | None = None

    def is_held_out(self, index: int, step: int) -> bool:
        """Return true for every eighth view, until the harmonics are measured on them."""
        return step <= self.measurement_step and index in self.held_out

    def measure_harmonics(
        self, step: int, looks: Callable[[], MeasurementViews]
    ) -> ViewDependence | None:
        if step != self.measurement_step or not self.held_out:
            return None
        views = looks()
        seen = [i for i in views.indices if i not in self.held_out]
        held_out = [i for i in views.indices if i in self.held_out]
        if not seen or not held_out:
            return None
        judged = list(views.views(held_out))
        found = find_view_dependent(
            views.views(seen), judged, views.options, views.background, self.tolerance
        )
        self.freeze(~found.kept_harmonics)
        return found

    def freeze(self, frozen: Tensor) -> None:
        """Keep the harmonics of the Gaussians ``frozen`` (N,) zero from now on."""
        self._frozen = None if bool(frozen.all()) else frozen

    def frozen_harmonics(self) -> Tensor | None:
        return self._frozen

    def follow(self, edit: TopologyEdit) -> None:
        if self._frozen is not None:
            self._frozen = edit.apply(self._frozen)

    def place(self, device: torch.device) -> None:
        self._frozen = None if self._frozen is None else self._frozen.to(device)

    def state(self) -> State:
        return {} if self._frozen is None else {"frozen": StateTensor(self._frozen, Role.TRAINING)}

    def restore(self, tensors: Mapping[str, Tensor], count: int) -> None:
        frozen = tensors.get("frozen")
        self._frozen = (
            None if frozen is None else require_tensor("frozen", frozen, (count,), torch.bool)
        )


def opacity_entropy(logits: Tensor) -> Tensor:
    """Return the mean of -o ln o over opacities o with ``logits`` (N,), of which there may be none
    (Zhang et al. 2024).

    It is largest at o = 1/e: what is fainter is pushed towards 0, what is more opaque towards 1.
    The gradient by a logit, -(ln o + 1) o (1 - o), is finite everywhere.
    """
    if not len(logits):
        return logits.sum()
    return -(logits.sigmoid() * logsigmoid(logits)).mean()


def rate_factor(step: int, steps: int) -> float:
    """Return the factor on the rate of ``step``, from 1: a linear warm-up, then a third after each
    milestone."""
    passed = sum(step > fraction * steps for fraction in _MILESTONES)
    return min(1.0, step / WARM_UP) / 3**passed


def _start_values(widths: list[int], generator: torch.Generator) -> dict[str, Tensor]:
    """Return Glorot weights and zero biases; the last layer is all zero, so that nothing is added
    at first."""
    values: dict[str, Tensor] = {}
    for i, (fan_in, fan_out) in enumerate(pairwise(widths)):
        weight = glorot(fan_in, fan_out, generator)
        values[f"weight{i}"] = torch.zeros_like(weight) if i == len(widths) - 2 else weight
        values[f"bias{i}"] = torch.zeros(fan_out, device=weight.device)
    return values
