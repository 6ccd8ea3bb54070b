"""Which cells of a field's space are not empty, learned from its densities (Instant-NGP; nerfacc's
occupancy grid)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dyngs.baselines.fields.ngp import NgpField
from dyngs.core.tensor_checks import require_tensor
from dyngs.ops.device import sent
from dyngs.ops.rays import Space

# Steps between updates; up to which step all cells are looked at where it is a power of two
EVERY, WARM_UP = 16, 256
DECAY = 0.95
THRESHOLD = 1e-2
"""Opacity above which a cell counts as occupied, or the mean of its cube if that is less: of a
sample as long as published, a 1,024th of the cube's diagonal."""
CHUNK = 1 << 17  # Cells looked at together


class Occupancy:
    """The largest opacity of a sample found in each cell, which fades until it is found again.

    Args:
        seen: bool of ``space.shape``: cells that may be occupied at all, see ``frusta``.
        num_random: random cells of each look after the warm-up; a quarter of all at most.
    """

    def __init__(self, space: Space, seen: Tensor, num_random: int) -> None:
        self._space = space
        self.seen = seen
        self._cells = seen.flatten().nonzero()[:, 0]
        self._count = seen.flatten(1).sum(1).clamp_min(1)
        self._num_random = min(num_random, -(-len(self._cells) // 4))
        self._values = torch.zeros(math.prod(space.shape), device="cpu")

    def place(self, device: torch.device) -> None:
        """Go on on ``device``; random numbers stay those of the CPU."""
        self.seen, self._cells, self._count, self._values = (
            x.to(device) for x in (self.seen, self._cells, self._count, self._values)
        )

    def is_due(self, step: int) -> bool:
        return step > EVERY and step % EVERY == 0

    @torch.no_grad()
    def updated(
        self, field: NgpField, step: int, times: tuple[float, ...], generator: torch.Generator
    ) -> Tensor:
        """Look at densities at random places of cells, at one of ``times``; return bool of
        ``space.shape``."""
        cells = self._chosen(field.occupied, step, generator)
        found = torch.cat([self._opacities(field, x, times, generator) for x in cells.split(CHUNK)])
        self._values[cells] = torch.maximum(self._values[cells] * DECAY, found)
        cubes = self._values.view(len(self._count), -1)
        levels = (cubes.double().sum(1) / self._count).clamp(max=THRESHOLD)
        return (cubes > levels[:, None]).view(self._space.shape)

    def state(self) -> dict[str, Tensor]:
        return {"values": self._values}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self._values = require_tensor("values", state["values"], tuple(self._values.shape)).clone()

    def _chosen(self, occupied: Tensor, step: int, generator: torch.Generator) -> Tensor:
        """Return indices of cells: of all ever less often as it warms up, else random and occupied
        ones.

        At most a quarter of all each.
        """
        if step <= WARM_UP and step & (step - 1) == 0:
            return self._cells
        drawn = self._cells[self._drawn(len(self._cells), self._num_random, generator)]
        full = occupied.flatten().nonzero()[:, 0]
        most = -(-len(self._cells) // 4)
        if len(full) > most:
            full = full[self._drawn(len(full), most, generator)]
        return torch.cat([drawn, full]).unique()

    def _drawn(self, below: int, count: int, generator: torch.Generator) -> Tensor:
        return sent(
            torch.randint(below, (count,), generator=generator, device="cpu"), self._values.device
        )

    def _opacities(
        self, field: NgpField, cells: Tensor, times: tuple[float, ...], generator: torch.Generator
    ) -> Tensor:
        space = self._space
        n = self._space.cells
        x = cells % n
        y = torch.div(cells, n, rounding_mode="floor") % n
        z = torch.div(cells, n * n, rounding_mode="floor")
        cascade = torch.div(z, n, rounding_mode="floor")
        z = z % n
        half = space.half * 2.0**cascade
        within = sent(torch.rand((len(cells), 3), generator=generator, device="cpu"), cells.device)
        places = torch.stack([x, y, z], 1) + within
        points = (places * (2 / n) - 1) * half[:, None] + within.new_tensor(space.centre)
        time = (
            times[int(torch.randint(len(times), (1,), generator=generator, device="cpu"))]
            if times
            else 0.0
        )
        return field.densities(points, time) * (half * (2 * math.sqrt(3) / 1024))
