"""Where motion begins before fixed cameras: nothing, one thing, two; and the paths of nodes."""

from __future__ import annotations

import pytest
import torch
from static_balls import Ball, Balls, filmed
from tiny_fields import cloud

from dyngs.config import ControlNodesField
from dyngs.deform.control_nodes import ControlNodes
from dyngs.deform.field import FieldSetup
from dyngs.deform.fixed_cameras.start import FirstMotion, first_motion

TIMES = tuple(i / 11 for i in range(12))


def started(balls: Balls, count: int = 6, limit: int = 600) -> FirstMotion:
    return first_motion(filmed(balls, TIMES, count), cloud(50), torch.arange(9), 1.0, limit)


def crossing(time: float) -> tuple[float, float, float]:
    return (1.6 * time - 0.8, 0.3, 0.1)


def test_one_ball_begins_on_its_way() -> None:
    found = started(lambda t: [Ball(crossing(t))])
    assert len(found.seeds) == 1
    assert found.finding is not None
    assert "1 thing travels" in found.finding
    assert "12 of 12" in found.finding
    places = torch.from_numpy(found.seeds[0].track.centers)
    assert (places - torch.tensor([crossing(t) for t in TIMES])).norm(dim=1).max() < 0.1


def test_two_balls_share_the_limit() -> None:
    """One of which comes only when half of the clip is over."""
    found = started(lambda t: [Ball(crossing(t))] + [Ball((0.2, 0.0, 2 * t - 1.7), 0.15, (0.1, 0.2, 0.9))] * (t > 0.5))
    assert sorted(len(one.track.times) for one in found.seeds) == [6, 12]
    assert sum(map(len, found.gaussians)) <= 600


@pytest.mark.parametrize(("count", "limit"), [(6, 600), (1, 600), (6, 0)])
def test_where_nothing_travels_nothing_begins(count: int, limit: int) -> None:
    """A ball that stands still; one camera, which sees no depth; no Gaussians allowed."""
    at = (lambda _: (0.0, 0.0, 0.0)) if count == 6 and limit else crossing
    found = started(lambda t: [Ball(at(t))], count, limit)
    assert found == FirstMotion()
    assert found.finding is None


def test_nodes_follow_the_tracks_and_all_others_stand() -> None:
    """At the times of the track the field takes the seeds to where it was; a Gaussian elsewhere stays."""
    found = started(lambda t: [Ball(crossing(t))])
    others = torch.tensor([[0.0, -0.9, 0.5], [0.1, -0.9, 0.5], [0.0, -0.8, 0.5], [0.0, -0.9, 0.6]])
    positions, paths = found.nodes(others, most=16, pieces=range(4, 12))
    assert len(positions) == len(paths) <= 16
    means = torch.cat([others, found.seeds[0].gaussians.means])
    setup = FieldSetup(torch.zeros(3), torch.ones(3), len(TIMES), len(means), 1.0)
    field = ControlNodes(ControlNodesField(nodes=16), setup, torch.Generator()).started(positions, {"means": paths})
    for i, time in enumerate(TIMES):
        offsets = field.offsets(means, time).means.detach()
        assert offsets[:4].norm(dim=1).max() < 1e-6
        moved = (means + offsets)[4:].mean(0) - found.seeds[0].placed(i).means.mean(0)
        assert moved.norm() < 0.05
