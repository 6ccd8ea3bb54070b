"""Which triangles are split, which removed."""

from __future__ import annotations

from dataclasses import replace

import torch
from small_triangles import bent, triangle

from dyngs.baselines.triangles.densify import change, useless
from dyngs.baselines.triangles.patches import Patches
from dyngs.baselines.triangles.tallies import Tallies


def seen(count: int) -> Tallies:
    """All triangles, everywhere, in each of 10 views."""
    tallies = Tallies(count)
    tallies.views += 10
    tallies.seen += 10
    tallies.cells += 1
    tallies.gradients += torch.arange(1.0, count + 1)
    return tallies


def test_a_good_triangle_is_useful_and_others_are_not() -> None:
    good = triangle((0, 0, 0), (1, 0, 0), (0, 1, 0))
    points = torch.cat([good] * 5)
    points[1] *= 1e-3
    points[2, :, 0] *= 50
    points[3, 2] = torch.nan
    tallies = seen(5)
    tallies.seen[4] = 0
    patches = Patches(points, torch.zeros(5, 6, 3), torch.zeros(5, 0, 3))
    assert useless(patches, tallies, 1.0).tolist() == [False, True, True, True, True]
    hidden = seen(1)
    hidden.cells[0, 3:] = 0
    assert useless(replace(patches, points=good), hidden, 1.0).tolist() == [True]
    for shown, goes in ((0.4, True), (0.6, False)):
        sliver = seen(1)
        sliver.cells *= shown * 10 / 36  # px of each of the 10 views
        assert useless(replace(patches, points=good), sliver, 1.0).tolist() == [goes]


def test_those_with_the_largest_gradients_are_split_within_the_limit() -> None:
    patches = bent(6)
    found = change(patches, seen(6), 1.0, 12, 1)
    assert found.kept.tolist() == [0, 1, 2, 3]
    points = found.of("points", patches.points)
    assert len(points) == 12
    torch.testing.assert_close(points[:4], patches.points[:4])
    assert torch.equal(
        found.of("harmonics", patches.harmonics)[4:8], patches.harmonics[4].expand(4, -1, -1)
    )
    moments = found.of_moments("points", torch.ones_like(patches.points))
    assert moments[:4].min() == 1
    assert moments[4:].abs().max() == 0
