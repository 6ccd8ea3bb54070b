"""Looking for NaN and infinity, fast enough to do it on every render."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from dyngs.errors import DyngsError
from dyngs.ops.native import array, core, num_threads


def check_finite(tensors: Mapping[str, Tensor], remedy: str = "clean the input") -> None:
    """Nothing, if every element is finite.

    Raises:
        DyngsError: naming the tensor, how many elements and how many rows are not finite, and the ``remedy``.
    """
    for name, x in tensors.items():
        count = core.count_nonfinite(array(x), num_threads())
        if count:
            rows = int((~finite_rows([x])).sum())
            raise DyngsError(f"{name} holds {count} NaN or infinite value(s) in {rows} of {len(x)} rows; {remedy}")


def finite_rows(tensors: Sequence[Tensor]) -> Tensor:
    """(N,) bool: rows that are finite in all of the tensors (N, ...)."""
    keep = torch.ones(len(tensors[0]), dtype=torch.bool)
    for x in tensors:
        keep &= torch.isfinite(x.detach()).reshape(len(x), math.prod(x.shape[1:])).all(dim=1)
    return keep
