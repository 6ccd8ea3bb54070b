"""Inputs of the colour network: the fused kernel against torch, and their meaning."""

from __future__ import annotations

import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import Sight
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.ops.quaternions import rotation_matrices
from dyngs.ops.shading import num_inputs, shading_inputs


def sight(
    seed: int, *, normals: bool, timed: bool, on_body: bool, dtype: torch.dtype = torch.float64
) -> Sight:
    """Eleven Gaussians, seven of them visible, unordered."""
    g = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> Tensor:
        return torch.randn(shape, generator=g, dtype=torch.float64).to(dtype)

    box = torch.stack([random(3), 0.1 + random(3).abs()])
    rest = random(11, 3), rotation_matrices(random(1, 4))[0]
    rows = torch.randperm(11, generator=g)[:7]
    return Sight(
        random(11, 3),
        random(11, 4),
        random(11, 3),
        rows,
        random(3),
        box,
        *(rest if on_body else (None, None)),
        0.3 if timed else None,
        normals,
    )


flags = st.booleans()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), flags, flags, flags, st.sampled_from([torch.float32, torch.float64]))
def test_inputs_equal_the_torch_reference(
    seed: int, normals: bool, timed: bool, on_body: bool, dtype: torch.dtype
) -> None:
    seen = sight(seed, normals=normals, timed=timed, on_body=on_body, dtype=dtype)
    base = torch.rand(7, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(
        dtype
    )
    found = shading_inputs(base, *seen)
    assert found.shape == (7, num_inputs(uses_time=timed, uses_normals=normals))
    # Numbers of at most 3 that come of some 30 roundings; 1e-5 is 84 units of float32, 1e-7 many of
    # float64.
    torch.testing.assert_close(found, reference.shading_inputs(base, *seen))


def test_degenerate_input_stays_finite() -> None:
    """A camera at a Gaussian's mean, a zero quaternion, equal scales, and no visible Gaussians."""
    zeros = torch.zeros(1, 3)
    seen = Sight(
        zeros,
        torch.zeros(1, 4),
        zeros,
        torch.tensor([0]),
        zeros[0],
        torch.tensor([[0.0] * 3, [1.0] * 3]),
    )
    base = torch.full((1, 3), 0.5)
    torch.testing.assert_close(shading_inputs(base, *seen), reference.shading_inputs(base, *seen))
    assert shading_inputs(base, *seen).isfinite().all()
    nothing = seen._replace(rows=torch.zeros(0, dtype=torch.long))
    assert shading_inputs(base[:0], *nothing).shape == (0, 13)


@pytest.mark.parametrize("row", [-1, 11])
def test_a_row_that_does_not_exist_is_refused(row: int) -> None:
    seen = sight(0, normals=True, timed=False, on_body=False)
    seen = seen._replace(rows=torch.tensor([0, row]))
    with pytest.raises(DyngsError, match="no such Gaussian"):
        shading_inputs(torch.zeros(2, 3, dtype=torch.float64), *seen)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32), st.floats(1e-3, 1e12))
def test_far_places_stay_bounded_and_in_order(seed: int, scale: float) -> None:
    points = scale * torch.randn(
        20, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    lengths = points.norm(dim=1)
    inside = reference.contracted(points).norm(dim=1)
    assert (inside <= 2).all()
    assert torch.equal(reference.contracted(points)[lengths <= 1], points[lengths <= 1])
    assert (inside[lengths.argsort()].diff() >= -1e-12).all()
