"""Which cells of a field's space are not empty, learned from its densities (Instant-NGP; nerfacc's occupancy grid)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dyngs.fields.ngp import NgpField
from dyngs.ops.device import sent
from dyngs.ops.rays import Space
from dyngs.tensor_checks import require_tensor

EVERY, WARM_UP = 16, 256  # Steps between updates; up to which step all cells are looked at each time
DECAY = 0.95
THRESHOLD = 1e-2  # Opacity of a sample, about, above which a cell counts as occupied; less where the mean is less
CHUNK = 1 << 17  # Cells looked at together


class Occupancy:
    """The largest opacity of a sample found in each cell, which fades until it is found again."""

    def __init__(self, space: Space) -> None:
        self._space = space
        self._values = torch.zeros(math.prod(space.shape), device="cpu")

    def place(self, device: torch.device) -> None:
        """Go on on ``device``; random numbers stay those of the CPU."""
        self._values = self._values.to(device)

    def is_due(self, step: int) -> bool:
        return step % EVERY == 0

    @torch.no_grad()
    def updated(self, field: NgpField, step: int, times: tuple[float, ...], generator: torch.Generator) -> Tensor:
        """Look at densities at random places of cells, at one of ``times``; return bool of ``space.shape``."""
        cells = self._chosen(field.occupied, step, generator)
        found = torch.cat([self._opacities(field, x, times, generator) for x in cells.split(CHUNK)])
        self._values[cells] = torch.maximum(self._values[cells] * DECAY, found)
        mean = float(self._values.double().mean())
        return (self._values > min(THRESHOLD, mean)).view(self._space.shape)

    def state(self) -> dict[str, Tensor]:
        return {"values": self._values}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self._values = require_tensor("values", state["values"], tuple(self._values.shape)).clone()

    def _chosen(self, occupied: Tensor, step: int, generator: torch.Generator) -> Tensor:
        """Return indices of cells: all while it warms up, then a quarter of all and as many occupied ones."""
        count, device = len(self._values), self._values.device
        if step <= WARM_UP:
            return torch.arange(count, device=device)
        drawn = sent(torch.randint(count, (count // 4,), generator=generator, device="cpu"), device)
        full = occupied.flatten().nonzero()[:, 0]
        if len(full) > count // 4:
            full = full[sent(torch.randint(len(full), (count // 4,), generator=generator, device="cpu"), device)]
        return torch.cat([drawn, full]).unique()

    def _opacities(
        self, field: NgpField, cells: Tensor, times: tuple[float, ...], generator: torch.Generator
    ) -> Tensor:
        space, n = self._space, self._space.cells
        x, y, z = (
            cells % n,
            torch.div(cells, n, rounding_mode="floor") % n,
            torch.div(cells, n * n, rounding_mode="floor"),
        )
        cascade, z = torch.div(z, n, rounding_mode="floor"), z % n
        half = space.half * 2.0**cascade
        within = sent(torch.rand((len(cells), 3), generator=generator, device="cpu"), cells.device)
        places = torch.stack([x, y, z], 1) + within
        points = (places * (2 / n) - 1) * half[:, None] + within.new_tensor(space.centre)
        time = times[int(torch.randint(len(times), (1,), generator=generator, device="cpu"))] if times else 0.0
        return field.densities(points, time) * field.step * 2.0**cascade
