"""Cells are occupied where the field is dense, and forget what is no longer there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from dyngs.baselines.fields.keys import NgpModel
from dyngs.baselines.fields.ngp import NgpField
from dyngs.baselines.fields.occupancy import DECAY, THRESHOLD, WARM_UP, Occupancy
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
    return Ball(
        space,
        plain.pixels,
        plain.levels,
        plain.table,
        plain.density,
        plain.colour,
        plain.occupied,
        plain.across,
    )


def occupancy_of(field: NgpField, num_random: int = 2**20) -> Occupancy:
    return Occupancy(field.space, torch.ones(field.space.shape, dtype=torch.bool), num_random)


def test_cells_of_all_cubes_are_found() -> None:
    field = ball(2)
    generator = torch.Generator().manual_seed(0)
    found = occupancy_of(field).updated(field, 32, (), generator)
    for cascade, half in enumerate((1.0, 2.0)):
        middles = (
            torch.stack(torch.meshgrid(*[(torch.arange(16) + 0.5) / 8 - 1] * 3, indexing="ij"), -1)
            * half
        )
        distance = middles.norm(dim=-1)
        cell = half / 8 * 3**0.5 / 2
        assert bool(found[cascade][distance < 0.6 - cell].all())
        assert not bool(found[cascade][distance > 0.6 + cell].any())


def test_what_is_gone_fades() -> None:
    field = ball(1)
    generator = torch.Generator().manual_seed(0)
    occupancy = occupancy_of(field)
    before = occupancy.updated(field, 32, (), generator)
    empty = replace(field, height=0.0)
    first = occupancy.updated(empty, 32, (), generator)
    assert bool(first[before].all()), "not at once"
    opacity = field.height * (2 * 3**0.5 / 1024)
    for _ in range(int(torch.tensor(THRESHOLD / opacity).log() / torch.tensor(DECAY).log()) + 2):
        last = occupancy.updated(empty, 32, (), generator)
    values = occupancy.state()["values"]
    assert float(values.max()) < THRESHOLD
    assert torch.equal(last, (values > values.double().mean()).view(last.shape)), (
        "the mean decides then"
    )


def test_later_half_of_the_cells_at_most_are_looked_at() -> None:
    field = ball(1)
    generator = torch.Generator().manual_seed(0)
    occupancy = occupancy_of(field)
    found = occupancy.updated(field, WARM_UP + 16, (), generator)
    seen = (occupancy.state()["values"] > 0).float().mean()
    assert 0 < float(seen) < 0.1, "half of a ball of a ninth of the cube"
    other = occupancy_of(field)
    other.load_state(occupancy.state())
    again = other.updated(field, WARM_UP + 32, (), torch.Generator().manual_seed(5))
    assert bool(again[found].all())


def test_few_random_cells_are_looked_at_where_few_are_asked_for() -> None:
    field = ball(1)
    generator = torch.Generator().manual_seed(0)
    field.occupied.zero_()
    occupancy = occupancy_of(field, 50)
    occupancy.updated(field, WARM_UP + 16, (), generator)
    assert 0 < int((occupancy.state()["values"] > 0).sum()) <= 50


def test_what_no_camera_sees_is_never_occupied() -> None:
    field = ball(1)
    generator = torch.Generator().manual_seed(0)
    seen = torch.ones(field.space.shape, dtype=torch.bool)
    seen[:, :8] = False
    occupancy = Occupancy(field.space, seen, 2**20)
    field.occupied.copy_(seen)
    for step in (64, WARM_UP + 16):
        found = occupancy.updated(field, step, (), generator)
        assert bool(found.any())
        assert not bool((found & ~seen).any())


def test_all_cells_are_looked_at_ever_less_often() -> None:
    field = ball(1)
    generator = torch.Generator().manual_seed(0)
    field.occupied.zero_()
    occupancy = occupancy_of(field, 1)
    assert [step for step in range(1, 80) if occupancy.is_due(step)] == [32, 48, 64]
    found = []
    for step in (32, 48, 64, 80, 128, 144, 256, 512):
        other = occupancy_of(field, 1)
        other.updated(field, step, (), generator)
        found.append(int((other.state()["values"] > 0).sum()) > 1)
    assert found == [True, False, True, False, True, False, True, False]


def test_each_cube_has_a_mean_of_its_own() -> None:
    """What is thin in an inner cube is not forgotten because it is thick in an outer one."""
    field = ball(2)
    thin = replace(field, height=0.1)
    found = occupancy_of(field).updated(thin, 32, (), torch.Generator().manual_seed(0))
    assert bool(found[0].any())
    assert bool(found[1].any())
