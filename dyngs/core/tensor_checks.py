"""Checks of tensors read from a file, before anything is computed with them.

A checksum finds accidents, not a file made to do harm: kernels and indexing rely on what is checked
here.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

REAL = torch.float32


def require_tensor(
    name: str, x: Tensor, shape: Sequence[int | None], dtype: torch.dtype | None = REAL
) -> Tensor:
    """Return ``x`` if it has this shape (None: any size) and dtype (None: any floating point), and
    is finite."""
    fits = len(x.shape) == len(shape) and all(
        n in (None, m) for n, m in zip(shape, x.shape, strict=True)
    )
    if not fits or (x.dtype != dtype if dtype is not None else not x.is_floating_point()):
        sizes = ", ".join("any" if n is None else str(n) for n in shape)
        wanted = "real numbers" if dtype is None else _said(dtype)
        raise ValueError(f"'{name}' is {_said(x.dtype)} {tuple(x.shape)}, not {wanted} ({sizes})")
    if x.is_floating_point() and not bool(x.isfinite().all()):
        raise ValueError(f"'{name}' holds NaN or infinite numbers")
    return x


def require_indices(
    name: str, x: Tensor, shape: Sequence[int | None], count: int, dtype: torch.dtype = torch.int64
) -> Tensor:
    """Return ``x`` if it holds whole numbers from 0 to ``count`` - 1 in this shape; else raise
    ValueError."""
    require_tensor(name, x, shape, dtype)
    if bool(((x < 0) | (x >= count)).any()):
        raise ValueError(f"'{name}' names something beyond the {count} that there are")
    return x


def require_ascending(name: str, x: Tensor) -> Tensor:
    """Return ``x`` (N,) if each number is larger than the one before; else raise ValueError."""
    if x.ndim != 1 or not bool((x[1:] > x[:-1]).all()):
        raise ValueError(f"'{name}' does not ascend")
    return x


def require_times(name: str, x: Tensor) -> Tensor:
    """Return ``x`` (N,) if it holds distinct times from 0 to 1, ascending; else raise
    ValueError."""
    require_ascending(name, require_tensor(name, x, (None,), None))
    if bool(((x < 0) | (x > 1)).any()):
        raise ValueError(f"'{name}' holds times outside [0, 1]")
    return x


def require_positive(name: str, x: Tensor) -> Tensor:
    """Return ``x`` if all of it is above 0; else raise ValueError."""
    if not bool((x > 0).all()):
        raise ValueError(f"'{name}' must be above 0 everywhere")
    return x


def _said(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
