"""Splitting and pruning of triangles."""

from __future__ import annotations

import torch
from small_triangles import bent, triangle

from dyngs.baselines.triangles.training import TriangleStatistics, densify, prunable


def seen(count: int) -> TriangleStatistics:
    """Statistics of triangles that cover everything in each of 10 views."""
    tallies = TriangleStatistics(count)
    tallies.views += 10
    tallies.seen += 10
    tallies.cells += 1
    tallies.gradients += torch.arange(1.0, count + 1)
    return tallies


def test_degenerate_triangles_are_prunable() -> None:
    good = triangle((0, 0, 0), (1, 0, 0), (0, 1, 0))
    points = torch.cat([good] * 5)
    points[1] *= 1e-3
    points[2, :, 0] *= 50
    points[3, 2] = torch.nan
    tallies = seen(5)
    tallies.seen[4] = 0
    assert prunable(points, tallies, 1.0).tolist() == [False, True, True, True, True]
    hidden = seen(1)
    hidden.cells[0, 3:] = 0
    assert prunable(good, hidden, 1.0).tolist() == [True]
    for shown, goes in ((0.4, True), (0.6, False)):
        sliver = seen(1)
        sliver.cells *= shown * 10 / 36  # px of each of the 10 views
        assert prunable(good, sliver, 1.0).tolist() == [goes]


def test_largest_gradients_are_split_within_the_limit() -> None:
    patches = bent(6)
    kept, added = densify(patches, seen(6), 1.0, 12, 1)
    assert kept.tolist() == [0, 1, 2, 3]
    assert len(added["points"]) == 8
    assert torch.equal(added["harmonics"][:4], patches.harmonics[4].expand(4, -1, -1))
