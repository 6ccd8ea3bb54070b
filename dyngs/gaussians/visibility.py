"""Visibility of Gaussians over time: bit masks at key times (4DGS-1K, Yuan et al. 2025).

Local letters: K key times, A Gaussians active at a time.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.core.state import Role, State, with_role

BITS = 8


@dataclass(frozen=True)
class VisibilityMasks:
    """Visibility of N Gaussians at K >= 2 key times."""

    times: tuple[float, ...]  # distinct, ascending, in [0, 1]
    bits: Tensor  # (K, ceil(N / 8)) uint8; Gaussian i is bit i % 8 of byte i // 8
    count: int  # N

    @staticmethod
    def pack(times: tuple[float, ...], seen: Tensor) -> VisibilityMasks:
        bits = np.packbits(seen.cpu().numpy(), axis=1, bitorder="little")
        return VisibilityMasks(times, torch.from_numpy(bits).to(seen.device), seen.shape[1])

    @property
    def seen(self) -> Tensor:
        return _unpacked(self.bits, self.count)

    def interval(self, time: float) -> int:
        """Return k such that ``time`` lies between key times k and k + 1; clamped to the first or
        last pair."""
        return min(max(bisect_right(self.times, time) - 1, 0), len(self.times) - 2)

    def active(self, interval: int) -> Tensor:
        """Return ascending indices (A,) of the Gaussians visible at either end of an interval."""
        return torch.nonzero(self.visible(interval))[:, 0]

    def visible(self, interval: int) -> Tensor:
        """Return (N,) bool: which Gaussians are visible at either end of an interval."""
        either = self.bits[interval] | self.bits[interval + 1]
        return _unpacked(either[None], self.count)[0]

    def select(self, index: Tensor) -> VisibilityMasks:
        return VisibilityMasks.pack(self.times, self.seen[:, index])

    def state(self) -> State:
        times = torch.tensor(self.times, dtype=torch.float64, device="cpu")
        count = torch.tensor([self.count], device="cpu")
        return with_role({"times": times, "bits": self.bits, "count": count}, Role.SHARED)

    @staticmethod
    def from_state(state: Mapping[str, Tensor], count: int) -> VisibilityMasks | None:
        """Return the masks in a state that ``state()`` returned; None for an empty state."""
        if not state:
            return None
        times = state["times"]
        bits = state["bits"]
        ascends = times.ndim == 1 and len(times) > 1 and bool((times[1:] > times[:-1]).all())
        of_all = bits.dtype == torch.uint8 and bits.shape == (times.numel(), -(-count // BITS))
        if not (ascends and of_all and state["count"].tolist() == [count]):
            raise ValueError("the visibility masks do not match the Gaussians")
        return VisibilityMasks(tuple(times.tolist()), bits, count)


def intersect_sorted(rows: Tensor, active: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return positions of the common indices in ``rows`` and in ``active`` (both ascending, <
    ``count``)."""
    matches = row_positions(rows, count)[active]
    places = torch.nonzero(matches >= 0)[:, 0]
    return matches[places], places


def row_positions(rows: Tensor, count: int) -> Tensor:
    """Return (count,) the position of each index in ``rows`` (M,); -1 for indices not in it."""
    positions = torch.full((count,), -1, device=rows.device)
    positions[rows] = torch.arange(len(rows), device=rows.device)
    return positions


def _unpacked(bits: Tensor, count: int) -> Tensor:
    places = torch.arange(BITS, dtype=torch.uint8, device=bits.device)
    return ((bits[..., None] >> places) & 1).bool().flatten(1)[:, :count]
