"""Features from a multiresolution hash grid (Instant-NGP, Müller et al. 2022), differentiable.

Local letters: M points, L levels, F features per level. Grid point g lies at (g - 0.5) / scale per
axis, clamped at the last one. Levels with few points have one row per point; others share rows by
a hash of the index.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from dyngs.ops.registration import Backward, empty_like, launch, register


@dataclass(frozen=True)
class HashLevels:
    """Scales, sizes and rows of the levels; their rows are concatenated in one table."""

    scales: tuple[float, ...]
    sizes: tuple[int, ...]
    rows: tuple[int, ...]

    @staticmethod
    def geometric(num_levels: int, coarsest: int, finest: int, most_rows: int) -> HashLevels:
        """Return levels of geometrically growing resolution (published formula).

        scale_l = coarsest b^l - 1, size_l = ceil(scale_l) + 1. ``most_rows`` per level is a power
        of two.
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
    """Interpolate features (M, L * F) at points (M, 3) in the unit cube.

    Differentiable once, in ``table``. Points outside are clamped to the cube; non-finite
    coordinates give NaN. Deterministic on any number of threads. Raises DyngsError for mismatched
    shapes or dtypes.
    """
    return hash_grid_op(
        coords.contiguous(), table, list(levels.scales), list(levels.sizes), list(levels.rows)
    )


def _select(
    features: Tensor,
    which: Tensor,
    coords: Tensor,
    table: Tensor,
    scales: list[float],
    sizes: list[int],
    rows: list[int],
) -> Tensor:
    return features.index_select(0, which)


def _select_backward(x: Backward) -> Sequence[Tensor]:
    return _hash_grid_backward(x._replace(inputs=x.inputs[2:]))


select_features_op = register("known_features", _select, _select_backward, "table")


def select_features(
    features: Tensor, which: Tensor, coords: Tensor, table: Tensor, levels: HashLevels
) -> Tensor:
    """Return rows ``which`` (K,) of ``features`` that ``hash_features`` computed at ``coords`` (K,
    3).

    The gradient by the table is computed as if they had been interpolated again.
    """
    return select_features_op(
        features, which, coords, table, list(levels.scales), list(levels.sizes), list(levels.rows)
    )
