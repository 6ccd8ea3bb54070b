"""Splines with other pieces: exact where they can be, nearest where they cannot."""

from __future__ import annotations

import pytest
import torch
from tiny_fields import cloud, stirred_field

from dyngs.deform.control_nodes import ControlNodes, refitted, spline_basis

PLACES = torch.linspace(0, 1, 41, dtype=torch.float64)


@pytest.mark.parametrize("pieces", [6, 9])
def test_divided_pieces_lose_nothing(pieces: int) -> None:
    """And come back: the fit to three pieces of what has three pieces is exact."""
    points = torch.randn(4, 6, 3, generator=torch.Generator().manual_seed(0)).double()
    finer = refitted(points, pieces)
    assert torch.allclose(
        spline_basis(PLACES, pieces) @ finer, spline_basis(PLACES, 3) @ points, atol=1e-9
    )
    assert torch.allclose(refitted(finer, 3), points, atol=1e-9)


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
