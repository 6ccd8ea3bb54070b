"""Shadows of balls: where light is hidden, how much of it, and what that does to colours."""

from __future__ import annotations

import math

import pytest
import torch

from dyngs.deform.bodies.shadows import light_left

SUN = torch.tensor([0.0, 0.0, 2.0])
BALL = torch.tensor([[0.0, 0.0, 1.0]])
RADIUS = torch.tensor([0.5])


def left_at(
    *points: tuple[float, float, float], shade: tuple[float, ...], label: int = -1
) -> list[float]:
    labels = torch.full((len(points),), label)
    return light_left(torch.tensor(points), labels, BALL, RADIUS, SUN, torch.tensor(shade)).tolist()


def test_direct_light_is_hidden_behind_a_ball_and_nowhere_else() -> None:
    hard = (0.6, 0.0, 0.0, math.log(0.05))
    behind, edge, beside, before = left_at(
        (0, 0, 0), (0.5, 0, -3), (0.8, 0, 0), (0, 0, 4), shade=hard
    )
    assert behind == pytest.approx(0.4, abs=0.01)
    assert edge == pytest.approx(0.7, abs=0.01)
    assert beside == pytest.approx(1.0, abs=1e-3)
    assert before == pytest.approx(1.0, abs=1e-3)


def test_a_ball_hides_as_much_of_the_sky_as_it_fills() -> None:
    near, far, within = left_at((0.5, 0, 1), (0, 2, 1), (0.1, 0, 1), shade=(0.0, 0.4, 0.0, 0.0))
    assert near == pytest.approx(0.6)
    assert far == pytest.approx(1 - 0.4 / 16)
    assert within == pytest.approx(0.6)


def test_a_ball_throws_no_shadow_on_itself_and_none_brightens() -> None:
    assert left_at((0, 0, 0.6), shade=(0.9, 0.9, 0.0, 0.0), label=0) == [1.0]
    assert left_at((0, 0, 0.4), shade=(-3.0, -1.0, 0.0, 0.0)) == [1.0]
    assert 0 < left_at((0, 0, 0.4), shade=(7.0, 7.0, 0.0, 0.0))[0] < 0.03


def test_the_direction_of_the_light_is_learned_from_a_shadow() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(500, 3, generator=generator) * torch.tensor([3.0, 3.0, 0.1]) - torch.tensor(
        [1.5, 1.5, 0.0]
    )
    labels = torch.full((500,), -1)
    true = torch.tensor([0.5, 0.0, 0.1, 0.2])
    wanted = light_left(points, labels, BALL, RADIUS, torch.tensor([0.5, -0.3, 1.0]), true)
    sun = SUN.clone().requires_grad_()
    shade = torch.tensor([0.2, 0.1, 0.0, 0.0], requires_grad=True)
    optimizer = torch.optim.Adam([sun, shade], lr=0.02)
    for _ in range(300):
        optimizer.zero_grad()
        (light_left(points, labels, BALL, RADIUS, sun, shade) - wanted).square().mean().backward()
        optimizer.step()
    found = torch.nn.functional.normalize(sun.detach(), dim=0)
    assert (
        float(found @ torch.nn.functional.normalize(torch.tensor([0.5, -0.3, 1.0]), dim=0)) > 0.99
    )
    torch.testing.assert_close(shade.detach()[0], true[0], atol=0.1, rtol=0)
