"""Visual hulls of balls at known positions, from cameras on a ring."""

from __future__ import annotations

import numpy as np
import pytest
from static_balls import Ball, filmed

from dyngs.deform.fixed_cameras.hulls import Blob, extract_blobs, silhouettes_at

LOW = np.full(3, -3.0)
HIGH = np.full(3, 3.0)
MOMENTS = 5


def hulls(*balls: Ball, count: int = 8) -> list[Blob]:
    """Hulls at the last of several times; the balls appear only then."""
    times = [i / (MOMENTS - 1) for i in range(MOMENTS)]
    clips = filmed(lambda t: balls if t == 1.0 else [], times, count)
    return sorted(
        extract_blobs(silhouettes_at(clips, 1.0), LOW, HIGH), key=lambda blob: -blob.radius
    )


# of four, three suffice: their hull has corners
@pytest.mark.parametrize(("count", "fraction"), [(4, 0.3), (8, 0.1)])
def test_visual_hull_of_one_ball(count: int, fraction: float) -> None:
    """The centre is accurate to a fraction of the radius, the radius to a fifth."""
    ball = Ball((0.31, -0.22, 0.13))
    (found,) = hulls(ball, count=count)
    assert np.linalg.norm(found.center - ball.center) < fraction * ball.radius
    assert found.radius == pytest.approx(ball.radius, rel=0.2)
    assert np.abs(found.color - ball.color).max() < 0.15
    if count == 8:
        assert np.linalg.norm(found.cubes - np.array(ball.center), axis=1).max() < 1.6 * ball.radius


def test_two_balls_have_separate_hulls() -> None:
    found = hulls(Ball((-0.4, 0.0, 0.1)), Ball((0.5, 0.2, -0.1), 0.15, (0.1, 0.2, 0.9)))
    places = np.array([blob.center for blob in found[:2]])
    assert np.abs(places - np.array([[-0.4, 0.0, 0.1], [0.5, 0.2, -0.1]])).max() < 0.05
    assert all(blob.radius < 0.08 for blob in found[2:]), "crossings of other silhouettes are small"


def test_object_occluded_in_one_camera_is_found() -> None:
    """Occlusion in one of many cameras is tolerated; with three cameras all must see the object."""
    times = [i / (MOMENTS - 1) for i in range(MOMENTS)]
    for count, number in ((8, 1), (3, 0)):
        clips = filmed(lambda t: [Ball((0.1, 0.0, 0.0))] if t == 1.0 else [], times, count)
        clips[0].changed[:] = False
        found = extract_blobs(silhouettes_at(clips, 1.0), LOW, HIGH)
        assert len(found) == number
        assert all(np.linalg.norm(blob.center - [0.1, 0.0, 0.0]) < 0.05 for blob in found)
