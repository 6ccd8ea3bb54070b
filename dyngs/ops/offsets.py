"""Adds what a deformation field says to rows of Gaussians, in one pass."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from dyngs.ops.native import array, core, num_threads


def add_offsets_(gaussians: Sequence[Tensor], rows: Tensor | None, offsets: Sequence[Tensor | None]) -> None:
    """Move M of N Gaussians in place, as ``dyngs.deform.field.deformed`` defines it; no gradient.

    Args:
        gaussians: (N, 3) means, (N, 4) quats, (N, 3) log scales, (N,) opacity logits, (N, K, 3) harmonics; contiguous,
            on the CPU.
        rows: (M,) int64 without repetition; None: the first M.
        offsets: (M, ...) of each in this order, of the base colour in place of harmonics; the first is there.

    Raises:
        IndexError: a row that does not exist.
    """
    dtype = gaussians[0].dtype
    core.add_offsets(
        tuple(array(x) for x in gaussians),
        None if rows is None else array(rows),
        tuple(None if x is None else array(x.to(dtype)) for x in offsets),
        num_threads(),
    )
