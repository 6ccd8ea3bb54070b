"""Gaussians and splines of tracks: where the ball is, in its colours, as many pieces as its motion needs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from static_balls import Ball, filmed

from dyngs.deform.fixed_cameras.hulls import Blob
from dyngs.deform.fixed_cameras.linking import Track
from dyngs.deform.fixed_cameras.seeds import Seeds, fitted, pays, pieces_for, seeds_of
from dyngs.deform.fixed_cameras.start import found_tracks

TIMES = tuple(i / 7 for i in range(8))
BALL = Ball((0.0, 0.0, 0.0), 0.3)
BOX = np.full(3, -2.0), np.full(3, 2.0)


def ball_at(time: float) -> Ball:
    return Ball((0.1, 0.2, 1.8 * time - 0.9), BALL.radius)


def along(places: np.ndarray, times: tuple[float, ...]) -> Track:
    blobs = [Blob(x, 0.2, x[None], 0.1, np.full(3, 0.5)) for x in places]
    return Track(times, tuple(blobs))


def test_seeds_cover_a_ball_and_pay() -> None:
    """On its surface, in its colour; at another place they would not pay."""
    footage = filmed(lambda t: [ball_at(t)], TIMES, 7)
    track = found_tracks(footage, *BOX)[0]
    assert len(track.times) == len(TIMES)
    seeds = seeds_of(track, footage, limit=500, num_terms=4, others=np.zeros((0, 3)))
    now = seeds.gaussians
    apart = (now.means - torch.tensor(ball_at(seeds.time).center)).norm(dim=1)
    assert ((apart - BALL.radius).abs() < 0.5 * BALL.radius).float().mean() > 0.8, "a hull has corners"
    assert (now.base_rgb.mean(0) - torch.tensor(BALL.color)).abs().max() < 0.1
    assert now.sh.shape == (len(now), 4, 3)
    assert pays(seeds, footage)
    beside = Seeds(track, seeds.time, now.replace(means=now.means + torch.tensor([0.0, 0.9, 0.0])))
    assert not pays(beside, footage)
    few = seeds_of(track, footage, limit=20, num_terms=1, others=np.zeros((0, 3)))
    assert len(few.gaussians) == 20
    assert few.gaussians.log_scales[0, 0] > now.log_scales[0, 0]


def test_seeds_begin_apart_from_other_things() -> None:
    """In the middle of the clip, unless something else that moves is there."""
    footage = filmed(lambda t: [ball_at(t)], TIMES)
    track = found_tracks(footage, *BOX)[0]
    begins = [
        seeds_of(track, footage, 50, 1, np.array(others).reshape(-1, 3)).time
        for others in ([], [(3.0, 0.0, 0.0)], [(0.1, 0.2, 0.0)])
    ]
    assert begins[0] == begins[1] in TIMES[3:5]
    assert begins[2] in (TIMES[0], TIMES[-1], TIMES[1], TIMES[-2])


def test_splines_have_as_many_pieces_as_the_motion_needs() -> None:
    times = tuple(np.linspace(0, 1, 24))
    straight = along(np.outer(times, [3.0, 1.0, 0.0]), times)
    hops = along(np.stack([[2 * t, 0.0, abs(np.sin(12 * t))] for t in times]), times)
    assert pieces_for([straight], range(7, 24)) == 7
    assert 7 < pieces_for([straight, hops], range(7, 24)) <= 23
    assert pieces_for([hops], range(5, 6)) == 5
    wild = along(np.random.default_rng(0).normal(size=(24, 3)), times)
    assert pieces_for([wild], range(7, 24)) == 23


@pytest.mark.parametrize("pieces", [1, 7, 23])
def test_a_spline_goes_on_through_gaps_and_beyond_the_ends(pieces: int) -> None:
    """At constant velocity: a straight line is a straight line of control points."""
    times = tuple(np.linspace(0, 1, 24))
    seen = times[4:9] + times[14:18]
    points = fitted(along(np.outer(seen, [3.0, 1.0, 0.0]), seen), pieces)
    assert points.shape == (pieces + 3, 3)
    assert points.diff(n=2, dim=0).abs().max() < 1e-3
    velocity = points.diff(dim=0).mean(0) * pieces
    torch.testing.assert_close(velocity, torch.tensor([3.0, 1.0, 0.0]), rtol=0, atol=0.01)
