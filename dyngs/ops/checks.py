"""Checks of what callers give: numbers in range, finite tensors, and images that kernels can count
and memory holds."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import torch
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.ops.native import core, num_threads
from dyngs.ops.registration import has_kernel, launch, register, shapes_only

LARGEST = 3.4e38  # options are computed with in float32

LARGEST_COUNT = 2**31 - 1
MAX_SIDE: int = core.MAX_SIDE  # px; float32 has no pixel centres beyond 2^23

UNASKED = 1 << 26  # bytes up to which the free memory is not asked for, because asking takes 0.1 ms

REMEDY = "lower the resolution, the scales or the number of views"


def check_number(name: str, value: object, low: float, high: float = LARGEST) -> None:
    """Raise an error unless ``value`` is a number from ``low`` to ``high``."""
    if not isinstance(value, (int, float)) or not low <= value <= high:
        upto = (
            ""
            if high == math.inf
            else " and finite"
            if high == LARGEST
            else f" and at most {high:g}"
        )
        raise DyngsError(f"{name} must be a number of at least {low:g}{upto}, got {value!r}")


def check_tensors(
    op: str,
    tensors: Mapping[str, tuple[Tensor, tuple[int, ...]]],
    dtype: torch.dtype | None = None,
) -> None:
    """Raise an error unless the ``tensors`` of ``op`` have these shapes, one device, and ``dtype``
    (None: floating point)."""
    first, device = next((name, x.device) for name, (x, _) in tensors.items())
    for name, (x, shape) in tensors.items():
        if tuple(x.shape) != shape:
            raise DyngsError(f"{op}: {name} must be {shape}, got {tuple(x.shape)}")
        fits = x.is_floating_point() if dtype is None else x.dtype == dtype
        if not fits or x.device != device:
            wanted = f"floating point on {device} like the {first}"
            wanted = wanted if dtype is None else f"{dtype} on {device}"
            raise DyngsError(f"{op}: {name} must be {wanted}, got {x.dtype} on {x.device}")


def check_near_and_far(near: object, far: object) -> None:
    """Raise an error unless they are the limits of a range of depths; ``far`` may be infinite."""
    check_number("near", near, 0)
    check_number("far", far, 0, math.inf)
    if not far > near:  # pyright: ignore[reportOperatorIssue]
        raise DyngsError(f"far must lie beyond near, got near {near!r} and far {far!r}")


def check_count(name: str, value: object, low: int, high: int) -> None:
    """Raise an error unless ``value`` is a whole number from ``low`` to ``high``."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise DyngsError(f"{name} must be a whole number from {low} to {high}, got {value!r}")


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Raise an error unless ``value`` is one of the ``choices``."""
    if not isinstance(value, str) or value not in choices:
        raise DyngsError(f"{name} must be one of {', '.join(choices)}, got {value!r}")


def check_size(width: int, height: int) -> None:
    """Raise an error unless images of this size can be drawn."""
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise DyngsError(
            f"render refused: an image of {width}x{height} px; its sides can be 1 to {MAX_SIDE} px"
        )


def check_memory(size: int, what: str, like: Tensor) -> None:
    """Raise an error unless ``size`` bytes for ``what`` fit what machine, control groups and
    RLIMIT_AS leave free.

    Only where ``like`` lies on the CPU: in a GPU's memory torch itself refuses what does not fit.
    Raises DyngsError: with both figures. (Where the system does not say, more than 16 GiB at once
    is refused.)
    """
    if shapes_only() or like.device.type != "cpu" or size <= UNASKED:
        return
    available = core.available_memory()
    if size > available:
        needed, left = (f"{x / 1e9:.1f} GB" for x in (size, available))
        raise DyngsError(
            f"render refused: {what} take {needed}; {left} of memory are available; {REMEDY}"
        )


def _count_nonfinite(tensors: list[Tensor]) -> Tensor:
    counts = tensors[0].new_zeros(len(tensors), dtype=torch.int32)
    for i, x in enumerate(tensors):
        launch(x, "count_nonfinite", x, counts[i : i + 1], num_threads())
    return counts.long()


count_nonfinite_op = register("count_nonfinite", _count_nonfinite)
"""Return (K,) int64: how many numbers of each of K tensors are NaN or infinite."""


def check_finite(tensors: Mapping[str, Tensor], remedy: str = "clean the input") -> None:
    """Raise an error unless every element of the ``tensors`` (float32 or float64, on one device) is
    finite."""
    given = [x.detach() for x in tensors.values()]
    if has_kernel("count_nonfinite", given[0].device):
        counts = count_nonfinite_op(given)
    else:
        counts = torch.stack([(~x.isfinite()).sum() for x in given])
    for (name, x), count in zip(tensors.items(), counts.cpu().numpy().tolist(), strict=True):
        if count:
            rows = int((~finite_rows([x])).sum())
            raise DyngsError(
                f"{name} holds {count} NaN or infinite value(s) in {rows} of {len(x)} rows; {remedy}"
            )


def finite_rows(tensors: Sequence[Tensor]) -> Tensor:
    """Return (N,) bool: the rows that are finite in all of the tensors (N, ...)."""
    keep = torch.ones(len(tensors[0]), dtype=torch.bool, device=tensors[0].device)
    for x in tensors:
        keep &= torch.isfinite(x.detach()).reshape(len(x), math.prod(x.shape[1:])).all(dim=1)
    return keep
