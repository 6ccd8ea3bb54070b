"""Named tensors with roles: the state of a scene, an optimizer or a strategy in a checkpoint."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, TypeVar, cast

import torch
from torch import Tensor


class Role(Enum):
    """Role of a tensor: the meaning of its rows, or that it is needed for training only."""

    PER_GAUSSIAN = "per Gaussian"
    PER_MOVING = "per moving Gaussian"
    SHARED = "shared"
    TRAINING = "training only"
    """Not needed for rendering."""


@dataclass(frozen=True)
class StateTensor:
    """A tensor and its role."""

    tensor: Tensor
    role: Role


State = dict[str, StateTensor]
"""Name to tensor and role."""

T = TypeVar("T")


def with_role(tensors: Mapping[str, Tensor], role: Role) -> State:
    """Return a state in which all ``tensors`` have the same role."""
    return {name: StateTensor(x, role) for name, x in tensors.items()}


def add_prefix(prefix: str, state: Mapping[str, StateTensor]) -> State:
    """Return the state with ``prefix.`` before every name."""
    return {f"{prefix}.{name}": x for name, x in state.items()}


def strip_roles(state: Mapping[str, StateTensor]) -> dict[str, Tensor]:
    """Return name to tensor, without the roles."""
    return {name: x.tensor for name, x in state.items()}


def select_prefix(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the tensors whose names start with ``prefix.``, without it."""
    start = f"{prefix}."
    return {name.removeprefix(start): x for name, x in tensors.items() if name.startswith(start)}


def move_to_device(value: T, device: torch.device | str) -> T:
    """Return a copy of ``value`` with all its tensors on ``device``.

    Uses the ``to`` method of ``value`` if it has one, else recurses into fields and items.
    """
    own: Any = value
    if hasattr(value, "to"):
        return own.to(device=device)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return move_fields_to(value, device)
    if isinstance(value, tuple):
        return cast(T, tuple(move_to_device(x, device) for x in own))
    if isinstance(value, dict):
        return cast(T, {name: move_to_device(x, device) for name, x in own.items()})
    return value


def move_fields_to(
    value: T, device: torch.device | str | None = None, dtype: torch.dtype | None = None
) -> T:
    """Return a copy of the dataclass ``value`` with its fields on ``device``, as ``moved_to`` has
    them.

    Args:
        value: dataclass with tensors and nested values.
        device: target device; None: unchanged.
        dtype: dtype of floating-point tensors; None: unchanged.
    """

    def moved(x: Any) -> Any:
        if isinstance(x, Tensor):
            return x.to(device, dtype if x.is_floating_point() else None)
        return x if device is None else move_to_device(x, device)

    own: Any = value
    fields = {f.name: moved(getattr(value, f.name)) for f in dataclasses.fields(own) if f.init}
    return cast(T, dataclasses.replace(own, **fields))
