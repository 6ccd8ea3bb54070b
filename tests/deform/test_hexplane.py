"""HexPlane grids: initialization, clamping, and extrapolation to unseen times."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_fields import cloud, stir, stirred_field, tiny_field, tiny_options, tiny_setup
from torch import Tensor

from dyngs.deform.keys import HexplaneField
from dyngs.deform.networks import Hexplane


def field_with_rows(rows: int) -> Hexplane:
    """Planes whose time row i has the value i everywhere."""
    options = tiny_options("hexplane")
    assert isinstance(options, HexplaneField)
    field = Hexplane(options, tiny_setup(num_times=2 * rows), torch.Generator().manual_seed(0))
    for level in field.levels:
        level.time.data[:] = torch.arange(float(rows))[None, :, None, None]
    return field


def rows_of(field: Hexplane) -> list[float]:
    """The value of each time row, which must be constant within the row."""
    found = torch.stack([level.time.detach()[:, :, 0, 0] for level in field.levels])
    for level in field.levels:
        assert torch.equal(
            level.time.detach(), level.time.detach()[:, :, :1, :1].expand_as(level.time)
        )
    assert (found == found[:1, :1]).all()
    return found[0, 0].tolist()


def outputs_at(field: Hexplane, means: Tensor, time: float) -> Tensor:
    offsets = vars(field.offsets(means, time)).values()
    return torch.cat([x.detach().reshape(len(means), -1) for x in offsets if x is not None], dim=1)


def test_planes_are_initialized_as_published() -> None:
    """Space planes uniform in [0.1, 0.5], time planes at 1; the clip sets the number of time rows."""
    field = tiny_field("hexplane")
    assert isinstance(field, Hexplane)
    for level, side in zip(field.levels, (5, 10), strict=True):
        assert level.space.shape == (3, side, side, 3)
        assert level.time.shape == (3, 5, side, 3)
        assert (level.time == 1).all()
        assert 0.1 <= level.space.min() < 0.15
        assert 0.45 < level.space.max() <= 0.5


def test_last_time_is_the_last_plane_row() -> None:
    """At time 1 only the last row counts, at time 0 only the first."""
    field = stirred_field("hexplane")
    assert isinstance(field, Hexplane)
    means = cloud().means
    ends = [outputs_at(field, means, t) for t in (0.0, 1.0)]
    for level in field.levels:
        level.time.data[:, 1:-1] += 1.0
    for x, time in zip(ends, (0.0, 1.0), strict=True):
        # x0 + (x1 - x0) is not x1 to the last bit
        torch.testing.assert_close(outputs_at(field, means, time), x)
    for level in field.levels:
        level.time.data[:, 0] += 1.0
    torch.testing.assert_close(outputs_at(field, means, 1.0), ends[1])
    assert (outputs_at(field, means, 0.0) - ends[0]).abs().max() > 0.01


@settings(max_examples=60, deadline=None)
@given(st.integers(2, 40), st.lists(st.floats(0, 0.5), min_size=1, max_size=6))
def test_extrapolation_fills_unseen_time_rows_only(rows: int, time_offsets: list[float]) -> None:
    """For any sequence of growing windows around the middle, up to the whole clip."""
    field = field_with_rows(rows)
    last = rows - 1
    windows = [(0.5 - x, 0.5 + x) for x in (*sorted(time_offsets), 0.5)]
    for seen, soon in pairwise(windows):
        before = rows_of(field)
        field.extend(seen, soon)
        after = rows_of(field)
        trained = [i for i in range(rows) if seen[0] * last - 1 < i < seen[1] * last + 1]
        assert [after[i] for i in trained] == [before[i] for i in trained]
    assert set(rows_of(field)) == {
        float(i) for i in range(rows) if windows[0][0] * last - 1 < i < windows[0][1] * last + 1
    }


def test_penalties_vanish_on_smooth_planes_only() -> None:
    """Second differences vanish on planes linear in each axis; time planes are compared with 1."""
    field = tiny_field("hexplane")
    assert isinstance(field, Hexplane)
    for level in field.levels:
        level.space.data[:] = torch.arange(float(level.space.shape[1]))[None, :, None, None]
    assert float(field.penalties(0.3)["plane smoothness"].detach()) == 0.0
    field.levels[0].time.data[1, 2] += 0.1
    rough = field.penalties(0.3)["plane smoothness"]
    assert rough.detach() > 0
    rough.backward()
    grad = field.parameters["time0"].grad
    assert grad is not None
    assert grad[1].any()
    assert not grad[2].any() or bool((field.parameters["time0"][2] != 1).any())
    field.levels[0].time.data[1, 2] += 0.1
    assert field.penalties(0.3)["plane smoothness"].detach() > rough.detach()


@pytest.mark.parametrize("flows", [False, True])
def test_gradient_of_positions_through_the_planes_is_optional(flows: bool) -> None:
    field = stirred_field("hexplane")
    assert isinstance(field, Hexplane)
    field.options = field.options.model_copy(update={"position_gradient": flows})
    means = cloud().means.requires_grad_()
    moved = means + field.offsets(means, 0.3).means
    moved.sum().backward()
    assert means.grad is not None
    assert bool((means.grad == 1).all()) != flows


def test_separate_heads_read_their_own_hidden_units() -> None:
    options = HexplaneField(
        channels=3, resolution=5, width=8, moves=("rotations", "scales"), separate_heads=True
    )
    field = Hexplane(options, tiny_setup(), torch.Generator().manual_seed(0))
    means = cloud().means
    assert not outputs_at(field, means, 0.3).any()
    stir(field)
    before = field.offsets(means, 0.3)
    field.parameters["bias1"].data[8:16] += 1.0  # hidden units of the second head
    after = field.offsets(means, 0.3)
    changes = [
        not torch.equal(one, other)
        for one, other in zip(vars(before).values(), vars(after).values(), strict=True)
        if one is not None
    ]
    assert changes == [False, True, False]


@pytest.mark.parametrize(("times_per_row", "rows"), [(2, 10), (4, 5), (1, 19), (30, 2)])
def test_time_planes_have_a_row_for_several_times(times_per_row: float, rows: int) -> None:
    options = HexplaneField(channels=1, resolution=2, width=2, times_per_row=times_per_row)
    field = Hexplane(options, tiny_setup(num_times=19), torch.Generator())
    assert field.levels[0].time.shape[1] == rows
