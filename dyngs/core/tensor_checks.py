"""Validation of tensors read from files.

Kernels and indexing rely on these checks. A checksum detects damage, but not malicious files.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

REAL = torch.float32


def require_tensor(
    name: str, x: Tensor, shape: Sequence[int | None], dtype: torch.dtype | None = REAL
) -> Tensor:
    """Return ``x`` if it is finite and has this shape (None: any size) and dtype (None: any float).

    Raises ValueError otherwise.
    """
    fits = len(x.shape) == len(shape) and all(
        n in (None, m) for n, m in zip(shape, x.shape, strict=True)
    )
    if not fits or (x.dtype != dtype if dtype is not None else not x.is_floating_point()):
        sizes = ", ".join("any" if n is None else str(n) for n in shape)
        wanted = "real numbers" if dtype is None else _dtype_name(dtype)
        raise ValueError(
            f"'{name}' is {_dtype_name(x.dtype)} {tuple(x.shape)}, not {wanted} ({sizes})"
        )
    if x.is_floating_point() and not bool(x.isfinite().all()):
        raise ValueError(f"'{name}' has NaN or infinite values")
    return x


def require_indices(
    name: str, x: Tensor, shape: Sequence[int | None], count: int, dtype: torch.dtype = torch.int64
) -> Tensor:
    """Return ``x`` if it has this shape and values in [0, ``count``); else raise ValueError."""
    require_tensor(name, x, shape, dtype)
    if bool(((x < 0) | (x >= count)).any()):
        raise ValueError(f"'{name}' has indices outside [0, {count})")
    return x


def require_ascending(name: str, x: Tensor) -> Tensor:
    """Return ``x`` (N,) if it is strictly ascending; else raise ValueError."""
    if x.ndim != 1 or not bool((x[1:] > x[:-1]).all()):
        raise ValueError(f"'{name}' is not strictly ascending")
    return x


def require_times(name: str, x: Tensor) -> Tensor:
    """Return ``x`` (N,) if it has strictly ascending times in [0, 1]; else raise ValueError."""
    require_ascending(name, require_tensor(name, x, (None,), None))
    if bool(((x < 0) | (x > 1)).any()):
        raise ValueError(f"'{name}' has times outside [0, 1]")
    return x


def require_positive(name: str, x: Tensor) -> Tensor:
    """Return ``x`` if all values are above 0; else raise ValueError."""
    if not bool((x > 0).all()):
        raise ValueError(f"'{name}' must be above 0 everywhere")
    return x


def _dtype_name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
