"""Initial motion before fixed cameras: points on what moves, with its colour and velocity."""

from __future__ import annotations

import pytest
import torch
from static_balls import Ball, Balls, filmed
from tiny_fields import cloud

from dyngs.deform.initial_motion import InitialMotion, TimedGaussians, find_initial_motion

TIMES = tuple(i / 11 for i in range(12))
RADIUS = 0.2
TOLERANCE = 0.6
"""Error of a velocity, world units per clip: a fourth of the radius from one time to the next."""


def started(balls: Balls, count: int = 6, limit: int = 600) -> InitialMotion:
    return find_initial_motion(filmed(balls, TIMES, count), cloud(50), 1.0, limit)


def crossing(time: float) -> tuple[float, float, float]:
    return (1.6 * time - 0.8, 0.3, 0.1)


def assert_on_ball(one: TimedGaussians, center: tuple[float, float, float]) -> None:
    distance = (one.gaussians.means - torch.tensor(center)).norm(dim=1)
    assert float(distance.median()) < RADIUS
    assert float(distance.quantile(0.9)) < 1.3 * RADIUS


def test_a_ball_has_gaussians_with_its_velocity_at_each_time() -> None:
    found = started(lambda t: [Ball(crossing(t))])
    assert found.message is not None
    assert "found motion at 12 of 12 times" in found.message
    assert sum(len(one.gaussians) for one in found.timed_gaussians) == pytest.approx(600, abs=12)
    for one in found.timed_gaussians:
        assert_on_ball(one, crossing(one.time))
        velocity = one.velocities.median(0).values
        torch.testing.assert_close(velocity, torch.tensor([1.6, 0.0, 0.0]), atol=TOLERANCE, rtol=0)
        colour = one.gaussians.base_rgb.mean(0)
        torch.testing.assert_close(colour, torch.tensor(Ball((0, 0, 0)).color), atol=0.05, rtol=0)


def test_two_balls_have_opposite_velocities() -> None:
    found = started(lambda t: [Ball(crossing(t)), Ball((0.8 - 1.6 * t, -0.5, -0.2))])
    for one in found.timed_gaussians:
        is_first = one.gaussians.means[:, 1] > -0.1
        for rows, sign in ((is_first, 1.0), (~is_first, -1.0)):
            assert rows.float().mean() > 0.25
            assert float(one.velocities[rows, 0].median()) == pytest.approx(
                1.6 * sign, abs=TOLERANCE
            )


@pytest.mark.parametrize(("end", "expected"), [(0.5, 1.6), (0.01, 0.0)])
def test_a_ball_that_vanishes_keeps_its_velocity(end: float, expected: float) -> None:
    """A ball that exists at a single time has none."""
    found = started(lambda t: [Ball(crossing(t))] if t <= end else [])
    last = found.timed_gaussians[-1]
    assert last.time <= end
    assert float(last.velocities[:, 0].median()) == pytest.approx(expected, abs=TOLERANCE)


@pytest.mark.parametrize(("count", "limit"), [(6, 600), (1, 600), (6, 0)])
def test_no_motion_without_changes(count: int, limit: int) -> None:
    """A static ball, a single camera (no depth), and a budget of no Gaussians."""
    at = (lambda _: (0.0, 0.0, 0.0)) if count == 6 and limit else crossing
    found = started(lambda t: [Ball(at(t))], count, limit)
    assert found == InitialMotion()
    assert found.message is None
