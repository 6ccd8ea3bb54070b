"""Block matching: where the drawn image belongs in the true one.

Gradients of an image see a few pixels far. A texture that lies a whole check beside its place has no gradient that
leads back; the place where a block of pixels fits best can be searched for.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

RADIUS = 3
"""Farthest shift that is looked for, px."""
BLOCK = 7
"""Side of the blocks that are compared, px."""
BETTER = 0.6
"""Most that the squared error of a block may be, as a fraction of its error in place, to be moved."""
FITS = 1.02
"""Largest error in place, as a fraction of the best, where a block belongs where it is."""
MIN_ERROR = 2e-4
"""Mean squared error of a block, summed over channels, up to which it counts as right."""


@dataclass(frozen=True)
class Matches:
    """Where the pixels of a drawn image belong.

    Attributes:
        shifts: (H, W, 2) along x and y, px; 0 where none is trusted.
        trusted: (H, W) 1 where the shift, which may be 0, is known, else 0.
    """

    shifts: Tensor
    trusted: Tensor


@torch.no_grad()
def matched(drawn: Tensor, truth: Tensor) -> Matches:
    """Return where the blocks of ``drawn`` (H, W, 3) lie in ``truth`` (H, W, 3), both with colours in [0, 1].

    A shift is trusted if it lowers the error clearly and the way back, from the block of ``truth`` that it leads to, is
    the same but for a pixel.
    """
    shifts, errors = _errors(drawn, truth)
    found, back = errors.argmin(0), _seen_from_there(shifts, errors).argmin(0)  # of equal ones the nearest
    best, in_place, there = errors.gather(0, found[None])[0], errors[0], shifts[found]
    height, width = best.shape
    y, x = torch.meshgrid(
        torch.arange(height, device=best.device), torch.arange(width, device=best.device), indexing="ij"
    )
    column, row = (x + there[..., 0]).clamp(0, width - 1), (y + there[..., 1]).clamp(0, height - 1)
    returns = (shifts[back[row, column]] - there).abs().amax(-1) <= 1
    moves = returns & (best < BETTER * in_place) & (in_place > MIN_ERROR)
    stays = (in_place <= FITS * best) | (in_place <= MIN_ERROR)
    return Matches(there * moves[..., None], (moves | stays).to(drawn))


def _errors(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Return shifts d (D, 2), x and y, nearest first, and mean squared errors (D, H, W) of a(q) against b(q + d)."""
    height, width, _ = a.shape
    planes, others = a.permute(2, 0, 1), F.pad(b.permute(2, 0, 1)[None], (RADIUS,) * 4, mode="replicate")[0]
    reach = range(-RADIUS, RADIUS + 1)
    shifts = sorted(((x, y) for y in reach for x in reach), key=lambda d: (d[0] ** 2 + d[1] ** 2, d))
    moved = (others[:, RADIUS + y : RADIUS + y + height, RADIUS + x : RADIUS + x + width] for x, y in shifts)
    squares = torch.stack([(planes - other).square().sum(0) for other in moved])
    means = F.avg_pool2d(squares[:, None], BLOCK, 1, BLOCK // 2, count_include_pad=False)[:, 0]
    return torch.tensor(shifts, device=a.device), means


def _seen_from_there(shifts: Tensor, errors: Tensor) -> Tensor:
    """Return errors (D, H, W) at p of the block that lies at p - d in a; infinite where that is outside."""
    height, width = errors.shape[1:]
    moved = torch.full_like(errors, float("inf"))
    for i, (x, y) in enumerate(shifts.tolist()):
        rows, columns = slice(max(y, 0), height + min(y, 0)), slice(max(x, 0), width + min(x, 0))
        moved[i, rows, columns] = errors[i, max(-y, 0) : height + min(-y, 0), max(-x, 0) : width + min(-x, 0)]
    return moved
