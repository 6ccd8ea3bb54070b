"""Pieces of what moves: what must move keeps moving, what need not stands, and scores never fall."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_fields import cloud, stirred_field

from dyngs.deform.field import Offsets, deformed
from dyngs.deform.pieces import PIECES, MovingPart, paid_motion
from dyngs.gaussians import Gaussians

COUNT = 40


def clusters() -> Gaussians:
    """Two groups of Gaussians far from each other along x, the first half left."""
    gaussians = cloud(COUNT)
    far = torch.zeros_like(gaussians.means)
    far[: COUNT // 2, 0], far[COUNT // 2 :, 0] = -100, 100
    return gaussians.replace(means=gaussians.means + far)


def part_of(gaussians: Gaussians) -> MovingPart:
    """All move along y with time."""
    mean = Offsets(torch.zeros(COUNT, 3))

    def offsets(time: float) -> Offsets:
        return Offsets(torch.tensor([0.0, time - 0.5, 0.0]).expand(COUNT, 3))

    return MovingPart(gaussians, torch.arange(COUNT), offsets, mean)


def like(truth: Callable[[float], Gaussians]) -> Callable[[Callable[[float], Gaussians]], list[float]]:
    """Scores that are higher the nearer the Gaussians are to where they belong."""
    return lambda at: [-float((at(time).means - truth(time).means).abs().mean()) for time in (0.0, 0.3, 1.0)]


def test_only_what_moves_in_truth_keeps_its_motion() -> None:
    part = part_of(clusters())
    left_moves = part.without(torch.arange(COUNT) >= COUNT // 2)
    found = paid_motion(part, like(left_moves))
    assert found.stays.tolist() == [False] * (COUNT // 2) + [True] * (COUNT // 2)
    assert 0 < found.moving < found.pieces <= PIECES
    assert found.after > found.before
    assert "others stand still" in str(found)


@pytest.mark.parametrize("all_move", [True, False])
def test_all_or_nothing(all_move: bool) -> None:
    part = part_of(clusters())
    found = paid_motion(part, like(part.without(torch.full((COUNT,), not all_move))))
    assert bool((found.stays == (not all_move)).all())
    assert found.moving == (found.pieces if all_move else 0)


@given(st.lists(st.floats(-50, 50), min_size=PIECES + 1, max_size=PIECES + 1))
def test_scores_never_fall(values: list[float]) -> None:
    left = iter(values)
    found = paid_motion(part_of(clusters()), lambda _: [next(left)])
    assert found.before == values[0]
    assert found.after >= found.before


@pytest.mark.parametrize("kind", ["hexplane", "control_nodes", "trajectory", "mlp"])
def test_what_stays_is_drawn_at_its_mean(kind: str) -> None:
    """All attributes; what does not stay is where the field has it."""
    gaussians, rows = cloud(9), torch.arange(2, 9)
    field = stirred_field(kind, 7)
    means = gaussians.means[rows]
    mean = field.offsets(means, 0.5)
    part = MovingPart(gaussians, rows, lambda time: field.offsets(means, time), mean)
    stays = torch.arange(7) < 3
    with torch.no_grad():
        found = part.without(stays)(0.9)
        still, moved = deformed(gaussians, mean, rows), deformed(gaussians, field.offsets(means, 0.9), rows)
    for name, x in found.tensors().items():
        wanted = torch.where(
            (torch.arange(9) < 5).view(-1, *[1] * (x.ndim - 1)), still.tensors()[name], moved.tensors()[name]
        )
        torch.testing.assert_close(x, wanted, rtol=0, atol=0, msg=name)
