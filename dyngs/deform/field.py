"""Interface of deformation fields, their decoder, and offsets applied to Gaussians.

Local letters: M moving Gaussians, a subset of the N Gaussians of a scene.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dyngs.core.initialisation import glorot_layers
from dyngs.core.state import Role, State, add_prefix, move_to_device, select_prefix
from dyngs.deform.keys import FieldSection
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.optimizer import Parameters
from dyngs.ops.adam import Count
from dyngs.ops.perceptron import Layer, perceptron
from dyngs.ops.skinning import add_offsets_, offset_gradients

F = TypeVar("F", bound="DeformationField")
Outer = TypeVar("Outer", bound="OuterField")

# Limit on the default number of key times; configs may set more, which takes memory.
MAX_KEY_TIMES = 256


@dataclass(frozen=True)
class Offsets:
    """Changes of M Gaussians from their canonical values at one time; zeros mean no change."""

    means: Tensor  # (M, 3) world units
    # (M, 4) added to the identity (1, 0, 0, 0); this rotation is applied after the canonical one.
    quats: Tensor | None = None
    log_scales: Tensor | None = None  # (M, 3)
    logit_opacities: Tensor | None = None  # (M,)
    # (M, 3) change of the degree-0 SH coefficients
    colors: Tensor | None = None

    def select(self, index: Tensor | slice) -> Offsets:
        return Offsets(**{name: x[index] for name, x in vars(self).items() if x is not None})


@dataclass(frozen=True)
class FieldSetup:
    """Properties of the scene that a field is built for."""

    # Centre and half size (3,) of the box that contains the motion, world units; no half size is
    # zero.
    center: Tensor
    half_size: Tensor
    num_times: int
    num_moving: int
    extent: float  # scene extent, world units; learning rates are relative to it
    num_sh_terms: int = 0  # of Gaussians whose SH coefficients may change over time; 0: none

    def normalize(self, means: Tensor) -> Tensor:
        """Normalise ``means`` (M, 3) to the box: [-1, 1] inside."""
        return (means - self.center) / self.half_size


@dataclass(frozen=True)
class MovingRows:
    """The moving Gaussians among A rendered ones."""

    means: Tensor  # (M, 3) canonical means of all moving Gaussians
    visible: Tensor | None  # indices of the rendered ones among the M; None: all
    rows: Tensor | None  # their rows among the A; None: all, in order


@dataclass(frozen=True)
class DeformedGaussians:
    """A Gaussians at one time."""

    gaussians: Gaussians
    offsets: Offsets | None = None  # of the moving ones, if the field computes offsets
    penalties: dict[str, Tensor] = dataclass_field(default_factory=dict[str, Tensor])


@dataclass(frozen=True)
class OpacityWindow:
    """Opacities of M moving Gaussians over time, in closed form; float64."""

    # (M,) second derivative at a time, per squared clip, of the opacity over that of an open window
    curvature: Tensor
    log_spans: Tensor  # (M,) logarithms of the lifetimes, in clips


class DeformationField:
    """Motion of canonical Gaussians over time; most fields compute offsets.

    The identity before training.
    """

    setup: FieldSetup
    parameters: Parameters
    """All trained parameters."""
    has_lifetime = False
    """Moving Gaussians exist for a limited time and are updated only in steps that render them."""
    can_fade = False
    """Opacities may fade in or out, so that a Gaussian exists for a part of the clip."""
    can_freeze = True
    """Moving Gaussians become static where their motion is too small to be visible."""
    depends_on_view = False
    """Motion differs between cameras."""

    @property
    def num_values(self) -> int:
        """Number of stored values."""
        return self.parameters.num_values

    @property
    def leaves(self) -> list[Tensor]:
        """All trained tensors."""
        return self.parameters.leaves

    def step(self, step: int, progress: float) -> Count:
        """Update all parameters; see ``Parameters.step``."""
        return self.parameters.step(step, progress)

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        """Return the offsets at ``time`` in [0, 1] of moving Gaussians with canonical ``means``
        (M, 3).

        ``rows`` (A,): compute only these rows, in this order; None: all.
        """
        raise NotImplementedError

    def deform(
        self,
        gaussians: Gaussians,
        moving: MovingRows,
        time: float,
        *,
        in_training: bool = False,
        eye: Tensor | None = None,
    ) -> DeformedGaussians:
        """Return ``gaussians`` (A) with the moving ones at ``time``; in training with penalties.

        ``eye``: (3,) camera centre, if the field depends on the view; None: no camera.
        """
        penalties: dict[str, Tensor] = {}
        if in_training and moving.visible is None:
            offsets, penalties = self.in_training(moving.means, time)
        else:
            offsets = self.offsets(moving.means, time, moving.visible)
            penalties = self.penalties(time) if in_training else {}
        return DeformedGaussians(apply_offsets(gaussians, offsets, moving.rows), offsets, penalties)

    def opacity_window(self, gaussians: Gaussians, time: float) -> OpacityWindow | None:
        """Return the opacities of the moving ``gaussians`` (M) around ``time``, in closed form;
        None: opacities do not change, or have no closed form."""
        return None

    def lifetimes(self, gaussians: Gaussians) -> Tensor | None:
        """Return the first and the last time (M, 2) at which each of the moving ``gaussians`` is
        drawn; None: any time."""
        return None

    def penalties(self, time: float) -> dict[str, Tensor]:
        """Return weighted regularisation terms of the field by name; some depend on ``time``."""
        return {}

    def in_training(self, means: Tensor, time: float) -> tuple[Offsets, dict[str, Tensor]]:
        """Return ``offsets`` and ``penalties`` of one time; subclasses share work between them."""
        return self.offsets(means, time), self.penalties(time)

    def extend(self, seen: tuple[float, float], soon: tuple[float, float]) -> None:
        """Extrapolate from the time window ``seen`` to the next window ``soon``."""

    def apply_shading(
        self, gaussians: Gaussians, rows: Tensor | None, which: Tensor | None, time: float
    ) -> Gaussians:
        """Apply shadows and shading of moving bodies to the Gaussians at ``time``.

        ``which``: the moving Gaussians that are drawn (None: all). ``rows``: their positions in
        ``gaussians`` (None: all rows, in order).
        """
        return gaussians

    def zero_gradients_outside_(self, window: tuple[float, float]) -> None:
        """Zero gradients of parameters that hardly affect the time ``window``; Adam would amplify
        them."""

    def apply_edit(self: F, edit: TopologyEdit) -> F:
        """Return the field after a topology edit of the moving Gaussians."""
        return self.with_parameters(self.parameters.apply_edit(Role.PER_MOVING, edit))

    def invalidate(self) -> None:
        """Clear caches that depend on the set of Gaussians."""

    def state(self) -> State:
        """Return the state for ``with_state``, without the setup."""
        return add_prefix("learned", self.parameters.state())

    def with_state(self: F, tensors: Mapping[str, Tensor]) -> F:
        """Return this field with the parameters in a state that ``state`` returned.

        Raises KeyError or ValueError for missing or inconsistent tensors.
        """
        return self.with_parameters(self.parameters.with_state(select_prefix(tensors, "learned")))

    def to(self: F, device: torch.device | str) -> F:
        field = self.with_parameters(self.parameters.to(device))
        field.setup = move_to_device(self.setup, device)
        return field

    def with_parameters(self: F, parameters: Parameters) -> F:
        field = copy.copy(self)
        field.parameters = parameters
        return field


class OuterField(DeformationField):
    """A field that modifies the offsets of an inner field of the same Gaussians."""

    def __init__(self, inner_field: DeformationField) -> None:
        self.setup = inner_field.setup
        self.inner_field = inner_field

    def modify(self, offsets: Offsets, means: Tensor, time: float, rows: Tensor | None) -> Offsets:
        """Return the modified ``offsets`` of the inner field; arguments as for ``offsets``."""
        raise NotImplementedError

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        return self.modify(self.inner_field.offsets(means, time, rows), means, time, rows)

    def in_training(self, means: Tensor, time: float) -> tuple[Offsets, dict[str, Tensor]]:
        offsets, penalties = self.inner_field.in_training(means, time)
        return self.modify(offsets, means, time, None), penalties

    @property
    def num_values(self) -> int:
        return self.parameters.num_values + self.inner_field.num_values

    @property
    def leaves(self) -> list[Tensor]:
        return [*self.parameters.leaves, *self.inner_field.leaves]

    def step(self, step: int, progress: float) -> Count:
        return self.parameters.step(step, progress) + self.inner_field.step(step, progress)

    def penalties(self, time: float) -> dict[str, Tensor]:
        return self.inner_field.penalties(time)

    def extend(self, seen: tuple[float, float], soon: tuple[float, float]) -> None:
        self.inner_field.extend(seen, soon)

    def apply_shading(
        self, gaussians: Gaussians, rows: Tensor | None, which: Tensor | None, time: float
    ) -> Gaussians:
        return self.inner_field.apply_shading(gaussians, rows, which, time)

    def zero_gradients_outside_(self, window: tuple[float, float]) -> None:
        self.inner_field.zero_gradients_outside_(window)

    def invalidate(self) -> None:
        self.inner_field.invalidate()

    def apply_edit(self: Outer, edit: TopologyEdit) -> Outer:
        field = super().apply_edit(edit)
        field.inner_field = self.inner_field.apply_edit(edit)
        return field

    def to(self: Outer, device: torch.device | str) -> Outer:
        field = super().to(device)
        field.inner_field = self.inner_field.to(device)
        return field


def innermost(field: DeformationField) -> DeformationField:
    """Return the innermost field of nested fields."""
    return innermost(field.inner_field) if isinstance(field, OuterField) else field


def apply_offsets(gaussians: Gaussians, offsets: Offsets, rows: Tensor | None = None) -> Gaussians:
    """Apply ``offsets`` to the ``rows`` (M,) of ``gaussians``; None: all rows, in order.
    Differentiable.

    No row may occur twice.
    """
    tensors = gaussians.tensors()
    dtype = gaussians.means.dtype
    changes = [None if x is None else x.to(dtype) for x in vars(offsets).values()]
    moved = _AddOffsets.apply(rows, *tensors.values(), *changes)
    return Gaussians(
        **{n: x if m is None else m for (n, x), m in zip(tensors.items(), moved, strict=True)}
    )


class _AddOffsets(torch.autograd.Function):
    """``apply_offsets`` for autograd; None for unchanged tensors, to avoid gradients of size N."""

    @staticmethod
    def forward(
        ctx: Any,
        rows: Tensor | None,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        logit_opacities: Tensor,
        sh: Tensor,
        *offsets: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        own = means, quats, log_scales, logit_opacities, sh
        copies = [
            x if by is None else x.contiguous().clone() for x, by in zip(own, offsets, strict=True)
        ]
        add_offsets_(copies, rows, offsets)
        quat_offsets = () if offsets[1] is None else (quats, offsets[1])
        ctx.save_for_backward(*([] if rows is None else [rows]), *quat_offsets)
        ctx.has_rows, ctx.count = rows is not None, len(means) if rows is None else len(rows)
        return tuple(None if by is None else x for x, by in zip(copies, offsets, strict=True))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = list(ctx.saved_tensors)
        rows = saved.pop(0) if ctx.has_rows else None
        by_offsets, by_quats = offset_gradients(grads, rows, ctx.count, *(saved or (None, None)))
        return None, grads[0], by_quats, *grads[2:], *by_offsets


def select_rows(x: Tensor, rows: Tensor | None) -> Tensor:
    """Return the ``rows`` of ``x``; None: all."""
    return x if rows is None else x.index_select(0, rows)


class Decoder:
    """A multilayer perceptron with a zero last layer; layer ``skip`` gets the features again.

    With ``separate_heads`` each head reads only its own part of the last hidden layer.
    """

    def __init__(
        self,
        num_inputs: int,
        hidden: Sequence[int],
        options: FieldSection,
        *,
        skip: int | None = None,
        separate_heads: bool = False,
    ) -> None:
        heads = list(head_sizes(options).values())
        self.widths = [num_inputs, *hidden, sum(heads)]
        self.skip = skip
        self.separate_heads = heads if separate_heads else []

    def start_values(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Return Glorot weights (Glorot and Bengio 2010), zero biases and a zero last layer."""
        *inputs, _ = self.widths
        if self.skip is not None:
            inputs[self.skip] += self.widths[0]
        if self.separate_heads:
            inputs[-1] //= len(self.separate_heads)
        values = glorot_layers(zip(inputs, self.widths[1:], strict=True), generator)
        values[f"weight{len(inputs) - 1}"].zero_()
        return values

    def __call__(self, features: Tensor, parameters: Parameters) -> Tensor:
        layers = parameters.layers(len(self.widths) - 1)
        if self.separate_heads:
            *others, last = layers
            weight = torch.block_diag(*last.weight.split(self.separate_heads))
            layers = [*others, Layer(weight, last.bias)]
        return perceptron(features, layers, skip=self.skip)


def head_sizes(options: FieldSection) -> Mapping[str, int]:
    """Return the output size of each head of ``Offsets`` by name, in order."""
    heads = {
        "rotations": ("quats", 4),
        "scales": ("log_scales", 3),
        "opacities": ("logit_opacities", 1),
        "colors": ("colors", 3),
    }
    return {"means": 3} | dict(heads[x] for x in heads if x in options.moves)


def split_heads(outputs: Tensor, options: FieldSection) -> Offsets:
    """Split the decoder outputs (M, K) into the heads of ``Offsets``."""
    return build_offsets(outputs[:, :3], outputs[:, 3:], head_sizes(options))


def build_offsets(means: Tensor, values: Tensor, heads: Mapping[str, int]) -> Offsets:
    """Build offsets from ``means`` (M, 3) and the concatenated ``values`` (M, D) of all other
    heads."""
    sizes = {name: size for name, size in heads.items() if name != "means"}
    parts = dict(zip(sizes, values.split(list(sizes.values()), dim=1), strict=True))
    if "logit_opacities" in parts:
        parts["logit_opacities"] = parts["logit_opacities"][:, 0]
    return Offsets(means, **parts)
