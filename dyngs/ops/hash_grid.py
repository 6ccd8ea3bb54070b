"""Features from a multiresolution hash grid (Müller et al. 2022, Instant Neural Graphics
Primitives), differentiable.

M points, L levels, F features of each. A level has samples at (g - 0.5) / scale along each
axis, clamped at its last. Where all fit, each has a row of its own; else they share rows by a hash
of their index.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.ops.native import num_threads
from dyngs.ops.registration import Gradient, empty_like, launch, register

WIDTHS = 1, 2, 4, 8  # Features of a level that there are kernels for


@dataclass(frozen=True)
class HashLevels:
    """Scale, samples along an axis, and rows of each level; rows of all levels lie one after the
    other in one table."""

    scales: tuple[float, ...]
    sizes: tuple[int, ...]
    rows: tuple[int, ...]

    @staticmethod
    def geometric(num_levels: int, coarsest: int, finest: int, most_rows: int) -> HashLevels:
        """Return levels whose resolution grows by the same factor each time; ``most_rows`` of each
        is a power of two.

        The published formula: scale_l = coarsest b^l - 1, size_l = ceil(scale_l) + 1.
        """
        growth = math.log(finest / coarsest) / max(num_levels - 1, 1)
        scales = tuple(coarsest * math.exp(growth * level) - 1 for level in range(num_levels))
        sizes = tuple(math.ceil(scale - 1e-9) + 1 for scale in scales)
        rows = tuple(min(size**3, most_rows) for size in sizes)
        return HashLevels(scales, sizes, rows)

    @property
    def num_rows(self) -> int:
        return sum(self.rows)


def _sizes(scales: list[float], sizes: list[int], rows: list[int]) -> list[tuple[float, int, int]]:
    return list(zip(scales, sizes, rows, strict=True))


def _hash_grid(
    coords: Tensor, table: Tensor, scales: list[float], sizes: list[int], rows: list[int]
) -> Tensor:
    features = table.new_empty(coords.shape[0], len(rows) * table.shape[1])
    launch(
        coords,
        "hash_grid_forward",
        coords,
        table,
        _sizes(scales, sizes, rows),
        features,
        num_threads(),
    )
    return features


def _hash_grid_backward(
    coords: Tensor,
    table: Tensor,
    grad: Tensor,
    scales: list[float],
    sizes: list[int],
    rows: list[int],
) -> Tensor:
    g_table = empty_like(table)
    launch(
        coords,
        "hash_grid_backward",
        coords,
        _sizes(scales, sizes, rows),
        grad,
        g_table,
        num_threads(),
    )
    return g_table


hash_grid_backward_op = register("hash_grid_backward", _hash_grid_backward)
"""The gradient by the table."""


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    coords, table, *ctx.levels = inputs
    ctx.save_for_backward(coords, table)


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    coords, table = ctx.saved_tensors
    scales, sizes, rows = ctx.levels
    return (
        None,
        hash_grid_backward_op(coords, table, grad.contiguous(), scales, sizes, rows),
        None,
        None,
        None,
    )


hash_grid_op = register("hash_grid", _hash_grid, gradient=Gradient(_save, _backward))
"""Features (M, L * F)."""


def hash_features(coords: Tensor, table: Tensor, levels: HashLevels) -> Tensor:
    """Return (M, L * F) features of points (M, 3) in the unit cube, interpolated between rows of
    ``table``.

    Differentiable once, in the table. What lies outside of the cube counts as on its surface; a
    coordinate that is no finite number gives features of NaN. The same bits on any number of
    threads. Raises DyngsError: shapes or dtypes that do not fit.
    """
    if coords.ndim != 2 or coords.shape[1] != 3:
        raise DyngsError(f"hash grid: points must be (M, 3), got {tuple(coords.shape)}")
    if table.ndim != 2 or len(table) != levels.num_rows or table.shape[1] not in WIDTHS:
        raise DyngsError(
            f"hash grid: the table must be ({levels.num_rows}, F) with F of 1, 2, 4 or 8, got {tuple(table.shape)}"
        )
    if coords.dtype != table.dtype or coords.device != table.device:
        raise DyngsError(
            f"hash grid: points must be {table.dtype} on {table.device} like the table, got {coords.dtype} on "
            f"{coords.device}"
        )
    if coords.requires_grad and torch.is_grad_enabled():
        raise DyngsError("hash grid: there is no gradient by the points; detach them")
    return hash_grid_op(
        coords.contiguous(), table, list(levels.scales), list(levels.sizes), list(levels.rows)
    )


def _known(
    features: Tensor,
    which: Tensor,
    coords: Tensor,
    table: Tensor,
    scales: list[float],
    sizes: list[int],
    rows: list[int],
) -> Tensor:
    return features.index_select(0, which)


def _save_known(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    _, _, coords, table, *ctx.levels = inputs
    ctx.save_for_backward(coords, table)


def _backward_known(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    return None, None, *_backward(ctx, grad)


known_features_op = register(
    "known_features", _known, gradient=Gradient(_save_known, _backward_known)
)


def known_features(
    features: Tensor, which: Tensor, coords: Tensor, table: Tensor, levels: HashLevels
) -> Tensor:
    """Return the rows ``which`` (K,) of ``features``, as ``hash_features`` of the points ``coords``
    (K, 3) gives them.

    Differentiable in the table as if they had been looked up again.
    """
    return known_features_op(
        features, which, coords, table, list(levels.scales), list(levels.sizes), list(levels.rows)
    )
