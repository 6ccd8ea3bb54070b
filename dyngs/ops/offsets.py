"""Offsets of a deformation field added to rows of Gaussians, in one pass."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from dyngs.ops.native import num_threads
from dyngs.ops.registration import InPlace, launch, register


def _add_offsets(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    logit_opacities: Tensor,
    sh: Tensor,
    rows: Tensor | None,
    by_means: Tensor,
    by_quats: Tensor | None,
    by_log_scales: Tensor | None,
    by_logit_opacities: Tensor | None,
    by_colors: Tensor | None,
) -> None:
    gaussians = [InPlace(x) for x in (means, quats, log_scales, logit_opacities, sh)]
    offsets = (by_means, by_quats, by_log_scales, by_logit_opacities, by_colors)
    launch(means, "add_offsets", gaussians, rows, offsets, num_threads())


add_offsets_op = register(
    "add_offsets_", _add_offsets, mutates=("means", "quats", "log_scales", "logit_opacities", "sh")
)


def add_offsets_(gaussians: Sequence[Tensor], rows: Tensor | None, offsets: Sequence[Tensor | None]) -> None:
    """Move M of N Gaussians in place, as ``dyngs.deform.field.deformed`` defines it; no gradient.

    Args:
        gaussians: (N, 3) means, (N, 4) quats, (N, 3) log scales, (N,) opacity logits, (N, K, 3) harmonics; contiguous
            where there are offsets.
        rows: (M,) int64 without repetition; None: the first M.
        offsets: (M, ...) of each in this order, of the base colour in place of harmonics; None but for the first: none.

    Raises:
        IndexError: a row that does not exist.
        DyngsError: Gaussians that are not contiguous.
    """
    by_means, by_quats, by_log_scales, by_logits, by_colors = (
        None if x is None else x.detach().to(gaussians[0].dtype) for x in offsets
    )
    assert by_means is not None
    # .data where nothing is added: a tensor that stays as it is must not count as changed for autograd
    means, quats, log_scales, logits, sh = (
        x.data.contiguous() if offset is None else x.detach() for x, offset in zip(gaussians, offsets, strict=True)
    )
    add_offsets_op(means, quats, log_scales, logits, sh, rows, by_means, by_quats, by_log_scales, by_logits, by_colors)
