"""Cells are occupied where the field is dense, and forget what is no longer there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from dyngs.fields.keys import NgpModel
from dyngs.fields.ngp import NgpField
from dyngs.fields.occupancy import DECAY, THRESHOLD, WARM_UP, Occupancy
from dyngs.ops.rays import Space

MODEL = NgpModel(levels=2, log2_rows=6, finest=16)


@dataclass(frozen=True)
class Ball(NgpField):
    """A ball of a density around a point."""

    radius: float = 0.6
    height: float = 50.0

    def densities(self, points: torch.Tensor, time: float) -> torch.Tensor:
        distance = (points - torch.tensor([0.2, 0.0, 0.0])).norm(dim=1)
        return torch.where(distance < self.radius, self.height, 0.0)


def ball(cascades: int) -> Ball:
    space = Space((0.2, 0.0, 0.0), 1.0, cascades, 16)
    plain = NgpField.new(MODEL, space, torch.Generator().manual_seed(0))
    return Ball(space, plain.levels, plain.table, plain.density, plain.colour, plain.occupied, plain.across)


def test_cells_of_all_cubes_are_found() -> None:
    field, generator = ball(2), torch.Generator().manual_seed(0)
    found = Occupancy(field.space).updated(field, 16, (), generator)
    for cascade, half in enumerate((1.0, 2.0)):
        middles = torch.stack(torch.meshgrid(*[(torch.arange(16) + 0.5) / 8 - 1] * 3, indexing="ij"), -1) * half
        distance, cell = middles.norm(dim=-1), half / 8 * 3**0.5 / 2
        assert bool(found[cascade][distance < 0.6 - cell].all())
        assert not bool(found[cascade][distance > 0.6 + cell].any())


def test_what_is_gone_fades() -> None:
    field, generator = ball(1), torch.Generator().manual_seed(0)
    occupancy = Occupancy(field.space)
    before = occupancy.updated(field, 16, (), generator)
    empty = replace(field, height=0.0)
    first = occupancy.updated(empty, 32, (), generator)
    assert bool(first[before].all()), "not at once"
    opacity = field.height * field.step
    for _ in range(int(torch.tensor(THRESHOLD / opacity).log() / torch.tensor(DECAY).log()) + 2):
        last = occupancy.updated(empty, 32, (), generator)
    values = occupancy.state()["values"]
    assert float(values.max()) < THRESHOLD
    assert torch.equal(last, (values > values.double().mean()).view(last.shape)), "the mean decides then"


def test_later_half_of_the_cells_at_most_are_looked_at() -> None:
    field, generator = ball(1), torch.Generator().manual_seed(0)
    occupancy = Occupancy(field.space)
    found = occupancy.updated(field, WARM_UP + 16, (), generator)
    seen = (occupancy.state()["values"] > 0).float().mean()
    assert 0 < float(seen) < 0.1, "half of a ball of a ninth of the cube"
    other = Occupancy(field.space)
    other.load_state(occupancy.state())
    again = other.updated(field, WARM_UP + 32, (), torch.Generator().manual_seed(5))
    assert bool(again[found].all())
