"""Features from a multiresolution hash grid (Müller et al. 2022, Instant Neural Graphics
Primitives), differentiable.

M points, L levels, F features of each. A level has samples at (g - 0.5) / scale along each
axis, clamped at its last. Where all fit, each has a row of its own; else they share rows by a hash
of their index.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from dyngs.ops.registration import Backward, empty_like, launch, register


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
    levels = _sizes(scales, sizes, rows)
    launch(coords, "hash_grid_forward", coords, table, levels, features)
    return features


def _hash_grid_backward(x: Backward) -> Sequence[Tensor]:
    coords, table, scales, sizes, rows = x.inputs
    by_table = empty_like(table)
    levels = _sizes(scales, sizes, rows)
    launch(coords, "hash_grid_backward", coords, levels, *x.grads, by_table)
    return [by_table]


hash_grid_op = register("hash_grid", _hash_grid, _hash_grid_backward, "table")
"""Features (M, L * F)."""


def hash_features(coords: Tensor, table: Tensor, levels: HashLevels) -> Tensor:
    """Return (M, L * F) features of points (M, 3) in the unit cube, interpolated between rows of
    ``table``.

    Differentiable once, in the table. What lies outside of the cube counts as on its surface; a
    coordinate that is no finite number gives features of NaN. The same bits on any number of
    threads. Raises DyngsError: shapes or dtypes that do not fit.
    """
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


def _known_backward(x: Backward) -> Sequence[Tensor]:
    return _hash_grid_backward(x._replace(inputs=x.inputs[2:]))


known_features_op = register("known_features", _known, _known_backward, "table")


def select_features(
    features: Tensor, which: Tensor, coords: Tensor, table: Tensor, levels: HashLevels
) -> Tensor:
    """Return the rows ``which`` (K,) of ``features``, as ``hash_features`` of the points ``coords``
    (K, 3) gives them.

    Differentiable in the table as if they had been looked up again.
    """
    return known_features_op(
        features, which, coords, table, list(levels.scales), list(levels.sizes), list(levels.rows)
    )
