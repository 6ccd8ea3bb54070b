"""Splines with other pieces: exact where they can be, nearest where they cannot."""

from __future__ import annotations

import pytest
import torch
from tiny_fields import cloud, stirred_field

from dyngs.deform.control_nodes import ControlNodes
from dyngs.deform.spline_fit import refitted, spline_basis
from dyngs.ops.nodes import cubic_fractions

PLACES = torch.linspace(0, 1, 41, dtype=torch.float64)


def test_the_basis_is_that_of_the_nodes() -> None:
    basis = spline_basis(torch.tensor([0.0, 0.3, 1.0]), 5)
    assert torch.allclose(basis.sum(1), torch.ones(3, dtype=torch.float64))
    # float32 places
    assert torch.allclose(basis[1, 1:5], torch.tensor(cubic_fractions(0.5)).double(), atol=1e-6)
    assert torch.allclose(basis[2, 4:], torch.tensor(cubic_fractions(1.0)).double())


@pytest.mark.parametrize("pieces", [6, 9])
def test_divided_pieces_lose_nothing(pieces: int) -> None:
    """And come back: the fit to three pieces of what has three pieces is exact."""
    points = torch.randn(4, 6, 3, generator=torch.Generator().manual_seed(0)).double()
    finer = refitted(points, pieces)
    assert torch.allclose(
        spline_basis(PLACES, pieces) @ finer, spline_basis(PLACES, 3) @ points, atol=1e-9
    )
    assert torch.allclose(refitted(finer, 3), points, atol=1e-9)


def test_polynomials_need_one_piece() -> None:
    cubic = refitted(torch.randn(2, 4, 1, generator=torch.Generator().manual_seed(1)).double(), 12)
    assert torch.allclose(
        spline_basis(PLACES, 1) @ refitted(cubic, 1), spline_basis(PLACES, 12) @ cubic, atol=1e-8
    )


def test_no_other_fit_is_nearer() -> None:
    """The mean square over time grows whichever way the control points are changed."""
    generator = torch.Generator().manual_seed(2)
    points = torch.randn(1, 11, 2, generator=generator).double()
    fitted = refitted(points, 3)
    places = (torch.arange(960, dtype=torch.float64) + 0.5) / 960
    wanted = spline_basis(places, 8) @ points

    def error(x: torch.Tensor) -> float:
        return float((spline_basis(places, 3) @ x - wanted).square().mean())

    for _ in range(10):
        assert error(
            fitted + 0.05 * torch.randn(fitted.shape, generator=generator).double()
        ) > error(fitted)


def test_a_field_with_all_nodes_and_pieces_moves_as_before() -> None:
    field = stirred_field("control_nodes")
    means = cloud().means
    match field:
        case ControlNodes():
            same = field.reduced(5, 3, means)
            fewer = field.reduced(3, 2, means)
        case _:
            raise AssertionError
    for name, x in vars(field.offsets(means, 0.37)).items():
        assert torch.allclose(x, getattr(same.offsets(means, 0.37), name), atol=1e-6)
    assert (fewer.num_nodes, fewer.num_pieces) == (3, 2)
    assert fewer.num_values < field.num_values
    assert len(fewer.offsets(means, 0.5).means) == len(means)
    kept = fewer.buffers["positions"]
    assert all(bool((field.buffers["positions"] == x).all(1).any()) for x in kept)
