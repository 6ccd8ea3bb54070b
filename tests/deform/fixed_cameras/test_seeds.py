"""Initial Gaussians at single times: position, colour and velocity of a tracked ball."""

from __future__ import annotations

import numpy as np
import torch
from static_balls import Ball, filmed

from dyngs.deform.fixed_cameras.initial_motion import find_tracks, improves_images, track_gaussians

TIMES = tuple(i / 7 for i in range(8))
BALL = Ball((0.0, 0.0, 0.0), 0.3)
BOX = np.full(3, -2.0), np.full(3, 2.0)


def ball_at(time: float) -> Ball:
    """The ball moves along z and changes its red in the second half of the clip."""
    return Ball(
        (0.1, 0.2, 1.8 * time - 0.9),
        BALL.radius,
        (0.9, 0.2, 0.1) if time < 0.5 else (0.7, 0.4, 0.2),
    )


def test_initial_gaussians_cover_a_ball_at_each_time() -> None:
    """Gaussians lie on its surface with its colour at that time, and fit no other position or
    time.
    """
    clips = filmed(lambda t: [ball_at(t)], TIMES, 7)
    (track,) = find_tracks(clips, *BOX)
    timed_gaussians = track_gaussians(track, clips, 4.0, num_terms=4)
    assert [one.time for one in timed_gaussians] == list(TIMES)
    for one in timed_gaussians:
        now = one.gaussians
        ball = ball_at(one.time)
        apart = (now.means - torch.tensor(ball.center)).norm(dim=1)
        assert ((apart - BALL.radius).abs() < 0.5 * BALL.radius).float().mean() > 0.8, (
            "a hull has corners"
        )
        assert (now.base_rgb.mean(0) - torch.tensor(ball.color)).abs().max() < 0.1
        assert now.sh.shape == (len(now), 4, 3)
        torch.testing.assert_close(one.velocity, torch.tensor([0.0, 0.0, 1.8]), rtol=0, atol=0.2)
        beside = now.replace(means=now.means + torch.tensor([0.0, 0.9, 0.0]))
        assert not improves_images(beside, one.time, clips)
    assert not improves_images(timed_gaussians[0].gaussians, TIMES[-1], clips)
