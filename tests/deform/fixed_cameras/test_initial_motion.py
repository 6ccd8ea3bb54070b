"""Initial motion for fixed cameras: no object, one object, two objects."""

from __future__ import annotations

import pytest
import torch
from static_balls import Ball, Balls, filmed
from tiny_fields import cloud

from dyngs.deform.fixed_cameras.initial_motion import InitialMotion, find_initial_motion
from dyngs.gaussians.rendering import RenderOptions

TIMES = tuple(i / 11 for i in range(12))


def started(balls: Balls, count: int = 6, limit: int = 600) -> InitialMotion:
    return find_initial_motion(filmed(balls, TIMES, count), cloud(50), 1.0, limit, RenderOptions())


def crossing(time: float) -> tuple[float, float, float]:
    return (1.6 * time - 0.8, 0.3, 0.1)


def test_ball_is_initialized_at_each_time() -> None:
    found = started(lambda t: [Ball(crossing(t))])
    assert found.message is not None
    assert "found moving objects at 12 of 12 times" in found.message
    for time in TIMES:
        now = [one for one in found.timed_gaussians if one.time == time]
        center = torch.cat([one.gaussians.means for one in now]).median(0).values
        assert (center - torch.tensor(crossing(time))).norm() < 0.1


@pytest.mark.parametrize(("count", "limit"), [(6, 600), (1, 600), (6, 0)])
def test_no_motion_without_changes(count: int, limit: int) -> None:
    """A static ball, a single camera (no depth), and a budget of no Gaussians."""
    at = (lambda _: (0.0, 0.0, 0.0)) if count == 6 and limit else crossing
    found = started(lambda t: [Ball(at(t))], count, limit)
    assert found == InitialMotion()
    assert found.message is None
