"""Pieces of what moves: each keeps its motion only where that pays in images that were not trained on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
from torch import Tensor

from dyngs.deform.field import Offsets, deformed
from dyngs.deform.nodes import spread_out
from dyngs.gaussians import Gaussians
from dyngs.gaussians.filters import filtered

PIECES = 16
"""Number of pieces, at most, that what moves is divided into."""
_CHUNK = 65536
"""Gaussians whose distances are taken at once."""

Scores = Callable[[Callable[[float], Gaussians]], Sequence[float]]
"""PSNR of images, dB, of Gaussians at a time."""


@dataclass(frozen=True)
class MovingPart:
    """M moving Gaussians among all.

    Attributes:
        gaussians: all, canonical.
        rows: (M,) of those that move.
        offsets: returns those of the M at a time.
        mean: the M offsets' means over time.
        filter_std: of the 3D filter, (N,); None: not filtered.
    """

    gaussians: Gaussians
    rows: Tensor
    offsets: Callable[[float], Offsets]
    mean: Offsets
    filter_std: Tensor | None = None

    def without(self, stays: Tensor) -> Callable[[float], Gaussians]:
        """Return what gives all Gaussians at a time, those of the M that ``stays`` (M,) names at their means."""

        def at(time: float) -> Gaussians:
            now = deformed(self.gaussians, _held(self.offsets(time), self.mean, stays), self.rows)
            return filtered(now, self.filter_std)

        return at


@dataclass(frozen=True)
class PaidMotion:
    """What is left of motion where it pays.

    Attributes:
        stays: (M,) bool, the moving Gaussians whose motion does not pay.
        pieces, moving: number of pieces in all, and of those whose motion pays.
        before, after: mean PSNR with all motion and with what pays, dB.
    """

    stays: Tensor
    pieces: int
    moving: int
    before: float
    after: float

    def __str__(self) -> str:
        found = f"pays in {self.moving} of {self.pieces} pieces of what moves"
        if self.moving == self.pieces:
            return f"{found}, on held-out training views"
        return f"{found}; the others stand still: {self.before:.2f} dB before, {self.after:.2f} after, held out"


@torch.no_grad()
def paid_motion(part: MovingPart, scores: Scores) -> PaidMotion:
    """Return which pieces of what moves are to keep their motion: those without which ``scores`` fall.

    Pieces are the Gaussians nearest to one of ``PIECES`` places that are far apart in the canonical form. One after the
    other is held at its mean, and stays there if the mean score is no lower than before: so it never falls.
    """
    labels = _nearest(part.gaussians.means.detach()[part.rows])
    stays = torch.zeros(len(labels), dtype=torch.bool, device=labels.device)
    before = best = fmean(scores(part.without(stays)))
    count = int(labels.max()) + 1 if len(labels) else 0
    still = 0
    for piece in range(count):
        tried = stays | (labels == piece)
        score = fmean(scores(part.without(tried)))
        if score >= best:
            stays, best, still = tried, score, still + 1
    return PaidMotion(stays, count, count - still, before, best)


def _nearest(means: Tensor) -> Tensor:
    """Return (M,) the piece that each of ``means`` (M, 3) belongs to."""
    seeds = means[spread_out(means, PIECES, means[:0])]
    chunks = [torch.cdist(x, seeds).argmin(1) for x in means.split(_CHUNK)]
    return torch.cat(chunks) if chunks else torch.zeros(0, dtype=torch.long, device=means.device)


def _held(offsets: Offsets, mean: Offsets, stays: Tensor) -> Offsets:
    """Return ``offsets`` with the ``mean`` ones where ``stays`` (M,); both have the same heads."""

    def held(now: Tensor | None, usual: Tensor | None) -> Tensor | None:
        if now is None or usual is None:
            return None
        return torch.where(stays.view(-1, *[1] * (now.ndim - 1)), usual, now)

    others = ("quats", "log_scales", "logit_opacities", "colors")
    means = torch.where(stays[:, None], mean.means, offsets.means)
    return Offsets(means, *(held(getattr(offsets, name), getattr(mean, name)) for name in others))
