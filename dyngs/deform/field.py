"""The interface of deformation fields, their decoder, and Gaussians with offsets applied.

Local letters: M moving Gaussians, a subset of the N of a scene.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dyngs.core.initialisation import glorot
from dyngs.core.state import State, move_to_device, part_of, add_prefix
from dyngs.deform.keys import FieldSection
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.optimizer import Parameters
from dyngs.ops.adam import Count
from dyngs.ops.perceptron import Layer, perceptron
from dyngs.ops.skinning import add_offsets_, offset_gradients

F = TypeVar("F", bound="DeformationField")
Outer = TypeVar("Outer", bound="OuterField")

# Limit on the default number of key times; longer clips may set more, which takes memory
MAX_KEY_TIMES = 256


@dataclass(frozen=True)
class Offsets:
    """Changes of M Gaussians from their canonical form at one time; zeros mean no change."""

    means: Tensor  # (M, 3) world units
    # (M, 4) added to the identity (1, 0, 0, 0); the sum turns the Gaussian after its own rotation
    quats: Tensor | None = None
    log_scales: Tensor | None = None  # (M, 3)
    logit_opacities: Tensor | None = None  # (M,)
    # (M, 3) of the base colour, in units of the constant SH coefficient
    colors: Tensor | None = None

    def select(self, index: Tensor | slice) -> Offsets:
        inner_field = (self.quats, self.log_scales, self.logit_opacities, self.colors)
        return Offsets(self.means[index], *(None if x is None else x[index] for x in inner_field))


@dataclass(frozen=True)
class FieldSetup:
    """Properties of the scene that a field needs."""

    # center, half_size: (3,) of the box in which things move, world units; no side is zero
    center: Tensor
    half_size: Tensor
    num_times: int
    num_moving: int
    extent: float  # of the scene, world units; learning rates are relative to it

    def normalized(self, means: Tensor) -> Tensor:
        """Return (M, 3) ``means`` in the box's own coordinates: [-1, 1] inside."""
        return (means - self.center) / self.half_size


class DeformationField:
    """Offsets of canonical Gaussians over time, the identity before training."""

    setup: FieldSetup
    parameters: Parameters
    """All that is optimised."""
    has_lifetime = False
    """Moving Gaussians are there for a while each, and stay as they are in steps that do not show
    them."""
    can_fade = False
    """Moving Gaussians may be there for a part of the clip only."""

    @property
    def num_values(self) -> int:
        """Number of values that the field stores."""
        return self.parameters.num_values

    @property
    def leaves(self) -> list[Tensor]:
        """All that receives gradients."""
        return self.parameters.leaves

    def step(self, step: int, progress: float) -> Count:
        """Update all that is optimised; see ``Parameters.step``."""
        return self.parameters.step(step, progress)

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        """Return the offsets at ``time`` in [0, 1] of the moving Gaussians with canonical ``means``
        (M, 3), in order.

        Only ``rows`` (A,) of them are requested, in this order, and cost anything; None: all.
        """
        raise NotImplementedError

    def penalties(self, time: float) -> dict[str, Tensor]:
        """Return differentiable regularizers of the field itself, weighted, by name; some look at
        ``time`` only."""
        return {}

    def in_training(self, means: Tensor, time: float) -> tuple[Offsets, dict[str, Tensor]]:
        """Return ``offsets`` and ``penalties`` of one time, which may share work."""
        return self.offsets(means, time), self.penalties(time)

    def extend(self, seen: tuple[float, float], soon: tuple[float, float]) -> None:
        """Continue what was learned for the times in ``seen`` to those in ``soon``, which are
        trained on next."""

    def apply_shading(
        self, gaussians: Gaussians, rows: Tensor | None, which: Tensor | None, time: float
    ) -> Gaussians:
        """Return the Gaussians drawn at ``time`` in the light that what moves leaves to them.

        Of those that move, ``which`` (None: all) are drawn, at ``rows`` (None: in order, and
        nothing else is).
        """
        return gaussians

    def zero_gradients_outside_(self, window: tuple[float, float]) -> None:
        """Drop the gradients of what times in ``window`` hardly show: Adam would take them for as
        much as any."""

    def apply_edit(self: F, edit: TopologyEdit) -> F:
        """Return the field after an edit of the moving Gaussians."""
        return self

    def invalidate(self) -> None:
        """Drop what was derived from the set of Gaussians; it is computed again when next
        needed."""

    def state(self) -> State:
        """Return the state that ``restored`` needs, without the setup."""
        return add_prefix("learned", self.parameters.state())

    def with_state(self: F, tensors: Mapping[str, Tensor]) -> F:
        """Return the field of a state that ``state`` returned, with the options and the setup of
        this one.

        Raises KeyError or ValueError: a tensor is missing, or is not as a field of these options
        has it.
        """
        return self.with_parameters(self.parameters.with_state(part_of(tensors, "learned")))

    def to(self: F, device: torch.device | str) -> F:
        field = self.with_parameters(self.parameters.to(device))
        field.setup = move_to_device(self.setup, device)
        return field

    def with_parameters(self: F, parameters: Parameters) -> F:
        field = copy.copy(self)
        field.parameters = parameters
        return field


class OuterField(DeformationField):
    """A field that changes the offsets of another one, ``others``, of the same Gaussians."""

    def __init__(self, inner_field: DeformationField) -> None:
        self.setup = inner_field.setup
        self.inner_field = inner_field

    def changed(self, found: Offsets, means: Tensor, time: float, rows: Tensor | None) -> Offsets:
        """Return the offsets ``found`` by the other field with the changes; arguments as of
        ``offsets``."""
        raise NotImplementedError

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        return self.changed(self.inner_field.offsets(means, time, rows), means, time, rows)

    def in_training(self, means: Tensor, time: float) -> tuple[Offsets, dict[str, Tensor]]:
        found, penalties = self.inner_field.in_training(means, time)
        return self.changed(found, means, time, None), penalties

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
        return self.around(self.inner_field.apply_edit(edit))

    def around(self: Outer, inner_field: DeformationField) -> Outer:
        """Return the same changes of another field of the same Gaussians."""
        field = copy.copy(self)
        field.inner_field = inner_field
        return field

    def to(self: Outer, device: torch.device | str) -> Outer:
        field = super().to(device)
        field.inner_field = self.inner_field.to(device)
        return field


def innermost(field: DeformationField) -> DeformationField:
    """Return the field within all others that change its offsets."""
    return innermost(field.inner_field) if isinstance(field, OuterField) else field


def apply_offsets(gaussians: Gaussians, offsets: Offsets, rows: Tensor | None = None) -> Gaussians:
    """Return ``gaussians`` with ``offsets`` applied to ``rows`` ((M,) long; None = all, in order);
    differentiable.

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
    """Gaussians with offsets, None for what stays as it is; the gradient fills and copies no arrays
    of all of them."""

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
        turned = () if offsets[1] is None else (quats, offsets[1])
        ctx.save_for_backward(*([] if rows is None else [rows]), *turned)
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
    """Return the ``rows`` of ``x``; all for None."""
    return x if rows is None else x.index_select(0, rows)


class Decoder:
    """A multilayer perceptron whose last layer starts at zero; layer ``skip`` sees the features
    once more."""

    def __init__(
        self,
        num_inputs: int,
        hidden: Sequence[int],
        options: FieldSection,
        *,
        skip: int | None = None,
    ) -> None:
        self.widths = [num_inputs, *hidden, sum(head_sizes(options).values())]
        self.skip = skip

    def start_values(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Return weights after Glorot and Bengio 2010 and zero biases; the last layer all zero."""
        values: dict[str, Tensor] = {}
        last = len(self.widths) - 2
        for i in range(last + 1):
            fan_in = self.widths[i] + (self.widths[0] if i == self.skip else 0)
            fan_out = self.widths[i + 1]
            weight = glorot(fan_in, fan_out, generator)
            values[f"weight{i}"] = torch.zeros_like(weight) if i == last else weight
            values[f"bias{i}"] = torch.zeros(fan_out, device="cpu")
        return values

    def __call__(self, features: Tensor, parameters: Parameters) -> Tensor:
        layers = [
            Layer(parameters[f"weight{i}"], parameters[f"bias{i}"])
            for i in range(len(self.widths) - 1)
        ]
        return perceptron(features, layers, skip=self.skip)


def head_sizes(options: FieldSection) -> Mapping[str, int]:
    """Return the number of outputs of each head of ``Offsets`` by name, in order."""
    heads = {
        "rotations": ("quats", 4),
        "scales": ("log_scales", 3),
        "opacities": ("logit_opacities", 1),
        "colors": ("colors", 3),
    }
    return {"means": 3} | dict(heads[x] for x in heads if x in options.moves)


def split_heads(outputs: Tensor, options: FieldSection) -> Offsets:
    """Return the outputs (M, K) of the heads by name."""
    return offsets_of(outputs[:, :3], outputs[:, 3:], head_sizes(options))


def offsets_of(means: Tensor, values: Tensor, heads: Mapping[str, int]) -> Offsets:
    """Return offsets with ``means`` (M, 3), and the ``values`` (M, D) of all other ``heads`` by
    name."""
    sizes = {name: size for name, size in heads.items() if name != "means"}
    parts = dict(zip(sizes, values.split(list(sizes.values()), dim=1), strict=True))
    if "logit_opacities" in parts:
        parts["logit_opacities"] = parts["logit_opacities"][:, 0]
    return Offsets(means, **parts)
