"""Curves per Gaussian: the basis is what it says, and what lies in its span is reproduced."""

from __future__ import annotations

import math

import pytest
import torch
from tiny_fields import cloud, tiny_setup
from torch import Tensor

from dyngs.config import TrajectoryField
from dyngs.deform.trajectory import Trajectory, basis
from dyngs.gaussians import TopologyEdit
from dyngs.state import tensors_of

MEANS_ONLY = {"move_rotations": False, "move_scales": False}


def table(polynomial: int, fourier: int, count: int = 2000) -> Tensor:
    """(count, B) values of the basis at the middles of even intervals of [0, 1]."""
    return torch.stack([basis((i + 0.5) / count, polynomial, fourier) for i in range(count)])


def new_trajectory(num_moving: int = 9, **options: object) -> Trajectory:
    return Trajectory(TrajectoryField(**options), tiny_setup(num_moving), torch.Generator())  # type: ignore[arg-type]


def test_known_values() -> None:
    """P1 = x, P2 = (3 x^2 - 1) / 2, P3 = (5 x^3 - 3 x) / 2 with x = 2 t - 1; sin and cos of whole periods over k."""
    for time in (0.0, 0.25, 0.37, 1.0):
        x = 2 * time - 1
        expected = [x, (3 * x**2 - 1) / 2, (5 * x**3 - 3 * x) / 2]
        for k in (1, 2):
            expected += [math.sin(2 * math.pi * k * time) / k, math.cos(2 * math.pi * k * time) / k]
        torch.testing.assert_close(basis(time, 3, 2), torch.tensor(expected, dtype=torch.float64))
    assert torch.equal(basis(1.0, 8, 0), torch.ones(8, dtype=torch.float64))


def test_terms_are_orthogonal_within_their_kind_and_have_no_mean() -> None:
    """Without a mean a curve cannot stand in for the canonical position."""
    values = table(5, 3)
    assert values.mean(0).abs().max() < 1e-6
    gram = values.T @ values / len(values)
    legendre = torch.tensor([1 / (2 * n + 1) for n in range(1, 6)], dtype=torch.float64)
    fourier = torch.tensor([0.5 / k**2 for k in (1, 2, 3) for _ in range(2)], dtype=torch.float64)
    torch.testing.assert_close(gram[:5, :5], torch.diag(legendre), rtol=0, atol=1e-5)
    torch.testing.assert_close(gram[5:, 5:], torch.diag(fourier), rtol=0, atol=1e-5)


@pytest.mark.parametrize(("polynomial", "fourier"), [(0, 0), (0, 2), (1, 0), (8, 32)])
def test_number_of_terms(polynomial: int, fourier: int) -> None:
    assert basis(0.3, polynomial, fourier).shape == (polynomial + 2 * fourier,)
    field = new_trajectory(polynomial=polynomial, fourier=fourier)
    assert not field.offsets(cloud().means, 0.3).means.any()
    assert field.parameters.num_values == 9 * (polynomial + 2 * fourier) * 10


def test_a_curve_in_the_span_is_reproduced() -> None:
    """A swinging throw: x = sin(2 pi t), y = t^2 - t + 1/6, z = t - 1/2, its coefficients by least squares."""
    times = torch.linspace(0, 1, 40, dtype=torch.float64)
    curve = torch.stack([torch.sin(2 * math.pi * times), times**2 - times + 1 / 6, times - 0.5], dim=1)
    values = torch.stack([basis(float(t), 2, 1) for t in times])
    field = new_trajectory(2, polynomial=2, fourier=1, **MEANS_ONLY)
    field.parameters["means"].data[1] = torch.linalg.lstsq(values, curve).solution.float()
    for t in (0.0, 0.123, 0.7, 1.0):
        found = field.offsets(torch.zeros(2, 3), t).means.detach()
        expected = torch.tensor([math.sin(2 * math.pi * t), t * t - t + 1 / 6, t - 0.5])
        torch.testing.assert_close(found, torch.stack([torch.zeros(3), expected]), rtol=0, atol=1e-6)


def test_each_gaussian_has_its_own_curve_and_takes_it_along() -> None:
    field = new_trajectory(3)
    for x in field.parameters.values().values():
        x += torch.arange(3.0)[:, None, None]
    index = torch.tensor([2, 0, 2, 1])
    before = field.offsets(torch.zeros(3, 3), 0.3)
    field = field.edited(TopologyEdit(index, torch.tensor([False, False, True, False])))
    after = field.offsets(torch.zeros(4, 3), 0.3)
    for name, x in vars(before).items():
        assert (x is None) == (getattr(after, name) is None)
        if x is not None:
            assert torch.equal(getattr(after, name), x[index]), name


def test_the_place_does_not_matter_and_nothing_is_penalized() -> None:
    field = new_trajectory()
    field.parameters["means"].data += 1.0
    assert torch.equal(field.offsets(torch.zeros(9, 3), 0.2).means, field.offsets(torch.ones(9, 3), 0.2).means)
    before = {name: x.clone() for name, x in tensors_of(field.parameters.state()).items()}
    field.extend((0.4, 0.6), (0.0, 1.0))
    assert all(torch.equal(x, before[name]) for name, x in tensors_of(field.parameters.state()).items())
    assert field.penalties(0.3) == {}
