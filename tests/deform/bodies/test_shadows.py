"""Shadows of balls: occluded directions, their amount, and their effect on colours."""

from __future__ import annotations

import math

import pytest
import torch

from dyngs.deform.bodies.field import light_fraction

SUN = torch.tensor([0.0, 0.0, 2.0])
BALL = torch.tensor([[0.0, 0.0, 1.0]])
RADIUS = torch.tensor([0.5])


def left_at(
    *points: tuple[float, float, float], shade: tuple[float, ...], label: int = -1
) -> list[float]:
    labels = torch.full((len(points),), label)
    return light_fraction(
        torch.tensor(points), labels, BALL, RADIUS, SUN, torch.tensor(shade)
    ).tolist()


def test_direct_light_is_hidden_behind_a_ball_and_nowhere_else() -> None:
    hard = (0.6, 0.0, 0.0, math.log(0.05))
    behind, edge, beside, before = left_at(
        (0, 0, 0), (0.5, 0, -3), (0.8, 0, 0), (0, 0, 4), shade=hard
    )
    assert behind == pytest.approx(0.4, abs=0.01)
    assert edge == pytest.approx(0.7, abs=0.01)
    assert beside == pytest.approx(1.0, abs=1e-3)
    assert before == pytest.approx(1.0, abs=1e-3)


def test_a_ball_throws_no_shadow_on_itself_and_none_brightens() -> None:
    assert left_at((0, 0, 0.6), shade=(0.9, 0.9, 0.0, 0.0), label=0) == [1.0]
    assert left_at((0, 0, 0.4), shade=(-3.0, -1.0, 0.0, 0.0)) == [1.0]
    assert 0 < left_at((0, 0, 0.4), shade=(7.0, 7.0, 0.0, 0.0))[0] < 0.03
