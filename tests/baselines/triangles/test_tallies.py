"""What images say about triangles."""

from __future__ import annotations

import pytest
import torch
from small_triangles import camera, triangle

from dyngs.baselines.triangles.patches import Patches
from dyngs.baselines.triangles.scene import TriangleOptions, TriangleScene
from dyngs.baselines.triangles.tallies import Tallies, most_pixels, outlines, slopes_of
from dyngs.core.state import tensors_of
from dyngs.ops.patches import Places, visible_patches

BEHIND = triangle((-1, -1, -9), (1, -1, -9), (0, 1, -9))
LARGE = triangle((-3, -3, 0), (3, -3, 0), (-3, 3, 0))


def places_of(*triangles: torch.Tensor) -> Places:
    return Places.of(*visible_patches(torch.cat(triangles), camera(), 0.2))


def test_slopes_are_those_of_a_step() -> None:
    image = torch.zeros(8, 9, 3)
    image[:, 5:] = 1
    slopes = slopes_of(image)
    assert (slopes[:, 4:6] == 1).all()
    assert (slopes[:, :4] == 0).all()
    assert (slopes_of(0.1 * image) == 0).all()


def test_what_is_seen_is_counted() -> None:
    places = places_of(LARGE, BEHIND)
    tallies = Tallies(2)
    tallies.count(places, torch.ones(16, 16))
    tallies.count(places, torch.zeros(16, 16))
    assert tallies.views == 2
    assert tallies.seen.tolist() == [2, 0]
    assert tallies.cells[1].sum() == 0
    assert tallies.cells[0].sum() == 2 * len(places.ids) / 4, "four drawn pixels a pixel"
    expected = float((~outlines(places)).sum()) / 4  # drawn pixels are quarters of the image's
    torch.testing.assert_close(tallies.edges, torch.tensor([expected, 0.0]))


def test_the_view_that_shows_most_counts() -> None:
    points = torch.cat([triangle((-1, -1, 0), (1, -1, 0), (-1, 1, 0)), BEHIND])
    patches = Patches(points, torch.zeros(2, 6, 3), torch.zeros(2, 0, 3))
    scene = TriangleScene(patches, 1.0, TriangleOptions(supersampling=2))
    most = most_pixels(scene, [camera(distance=8), camera(), camera(distance=6)])
    # half a square of 2 units, 32 * 1.2 / 4 px each
    assert most[0] == pytest.approx(0.5 * 19.2**2, rel=0.03)
    assert most[1] == 0
    assert torch.equal(most, most_pixels(scene, [camera()]))


def test_outlines_are_where_ids_change() -> None:
    found = torch.zeros(32, 32, dtype=torch.bool)
    places = places_of(LARGE)
    found[places.rows[0] >= 0] = outlines(places)
    assert not found[:4, :4].any()
    assert found.any()
    assert len(outlines(places_of(BEHIND))) == 0


def test_they_are_restored() -> None:
    tallies = Tallies(2)
    tallies.count(places_of(LARGE, BEHIND), torch.ones(32, 32))
    again = Tallies.restored(tensors_of(tallies.state()), 2)
    assert all(torch.equal(x, again.tensors()[name]) for name, x in tallies.tensors().items())
