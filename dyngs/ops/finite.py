"""Checks for NaN and infinity that are fast enough for every render."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from dyngs.errors import DyngsError
from dyngs.ops.native import num_threads
from dyngs.ops.registration import has_kernel, launch, register


def _count_nonfinite(x: Tensor) -> Tensor:
    count = x.new_zeros(1, dtype=torch.int32)
    launch(x, "count_nonfinite", x, count, num_threads())
    return count[0].long()


count_nonfinite_op = register("count_nonfinite", _count_nonfinite)


def check_finite(tensors: Mapping[str, Tensor], remedy: str = "clean the input") -> None:
    """Raise an error unless every element of the ``tensors`` (float32 or float64) is finite.

    Raises:
        DyngsError: naming the tensor, how many elements and how many rows are not finite, and the ``remedy``.
    """
    for name, x in tensors.items():
        native = has_kernel("count_nonfinite", x.device)
        count = int(count_nonfinite_op(x.detach()) if native else (~x.isfinite()).sum())
        if count:
            rows = int((~finite_rows([x])).sum())
            raise DyngsError(f"{name} holds {count} NaN or infinite value(s) in {rows} of {len(x)} rows; {remedy}")


def finite_rows(tensors: Sequence[Tensor]) -> Tensor:
    """Return (N,) bool: the rows that are finite in all of the tensors (N, ...)."""
    keep = torch.ones(len(tensors[0]), dtype=torch.bool, device=tensors[0].device)
    for x in tensors:
        keep &= torch.isfinite(x.detach()).reshape(len(x), math.prod(x.shape[1:])).all(dim=1)
    return keep
