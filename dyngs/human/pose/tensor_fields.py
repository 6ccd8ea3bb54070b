"""The tensors of a dataclass, moved to a device together."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import Tensor

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    T = TypeVar("T", bound=DataclassInstance)
else:
    T = TypeVar("T")


def tensors_to(value: T, device: torch.device | str | None, dtype: torch.dtype | None = None) -> T:
    """Return the dataclass with its tensors on ``device``, floating-point ones in ``dtype``; None leaves either."""
    tensors = {f.name: x for f in fields(value) if isinstance(x := getattr(value, f.name), Tensor)}
    return replace(value, **{k: x.to(device, dtype if x.is_floating_point() else None) for k, x in tensors.items()})
