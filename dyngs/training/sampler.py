"""The order in which training views are drawn."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from dyngs.tensor_checks import require_indices


class ViewSampler:
    """Every view once per epoch, in a new random order each time."""

    def __init__(self, num_views: int) -> None:
        self.num_views = num_views
        self._order = torch.zeros(0, dtype=torch.long, device="cpu")
        self._position = 0

    def next(self, generator: torch.Generator, wanted: Callable[[int], bool]) -> int:
        """Return the index of the next view that is ``wanted``, of which there must be one; others are passed over.

        ``generator`` is drawn from once per epoch.
        """
        while True:
            if self._position >= len(self._order):
                self._order = torch.randperm(self.num_views, generator=generator, device="cpu")
                self._position = 0
            self._position += 1
            index = int(self._order[self._position - 1])
            if wanted(index):
                return index

    def coming(self, count: int, wanted: Callable[[int], bool]) -> list[int]:
        """Return up to ``count`` views of this epoch that come next, by what is ``wanted`` now; nothing is drawn."""
        found: list[int] = []
        for index in self._order[self._position :].tolist():
            if len(found) == count:
                break
            if wanted(index):
                found.append(index)
        return found

    def state(self) -> dict[str, Tensor]:
        return {"order": self._order, "position": torch.tensor([self._position], device="cpu")}

    def load_state(self, state: dict[str, Tensor]) -> None:
        order = require_indices("order", state["order"], (None,), self.num_views)
        position = require_indices("position", state["position"], (1,), len(order) + 1)
        self._order, self._position = order.clone(), int(position)
