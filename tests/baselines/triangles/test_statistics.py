"""Image statistics of triangles: pixel counts and outlines."""

from __future__ import annotations

import torch
from small_triangles import camera, triangle

from dyngs.baselines.triangles.training import (
    MIN_EDGE,
    TriangleStatistics,
    image_gradients,
    near_outline,
)
from dyngs.ops.patches import PatchSamples, visible_patches

BEHIND = triangle((-1, -1, -9), (1, -1, -9), (0, 1, -9))
LARGE = triangle((-3, -3, 0), (3, -3, 0), (-3, 3, 0))


def places_of(*triangles: torch.Tensor) -> PatchSamples:
    return PatchSamples.of(*visible_patches(torch.cat(triangles), camera(), 0.2))


def test_visible_pixels_are_counted() -> None:
    places = places_of(LARGE, BEHIND)
    tallies = TriangleStatistics(2)
    tallies.count(places, torch.ones(16, 16))
    tallies.count(places, torch.zeros(16, 16))
    assert tallies.views == 2
    assert tallies.seen.tolist() == [2, 0]
    assert tallies.cells[1].sum() == 0
    assert tallies.cells[0].sum() == 2 * len(places.ids) / 4, "four drawn pixels a pixel"
    expected = float((~near_outline(places)).sum()) / 4  # drawn pixels are quarters of the image's
    torch.testing.assert_close(tallies.edges, torch.tensor([expected, 0.0]))


def test_outlines_are_where_ids_change() -> None:
    found = torch.zeros(32, 32, dtype=torch.bool)
    places = places_of(LARGE)
    found[places.rows[0] >= 0] = near_outline(places)
    assert not found[:4, :4].any()
    assert found.any()
    assert len(near_outline(places_of(BEHIND))) == 0


def test_image_gradients_are_those_of_prewitt() -> None:
    image = torch.rand(9, 13, 3, generator=torch.Generator().manual_seed(0))
    across = torch.tensor([[-1.0, 0, 1]] * 3) / 3
    kernels = torch.stack([across, across.T])[:, None]
    inner = torch.nn.functional.conv2d(image.permute(2, 0, 1)[:, None], kernels)
    sizes = inner.square().sum(1).sqrt()
    sizes[sizes < MIN_EDGE] = 0
    found = image_gradients(image)
    torch.testing.assert_close(found[1:-1, 1:-1], sizes.mean(0))
    assert found.shape == image.shape[:2]
    assert image_gradients(0.1 * image).abs().max() == 0
