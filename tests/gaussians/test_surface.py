"""Surface extraction from a ball of Gaussians."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scaled_files import scaled
from seen_ball import HIGH, LOW, RADIUS, views
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0
from dyngs.gaussians import Gaussians
from dyngs.gaussians.static_scene import StaticScene
from dyngs.gaussians.surface import (
    Mesh,
    count_holes,
    extract_surface,
    fuse_depths,
    keep_largest_components,
    opaque_box,
)
from dyngs.io.formats.similarity import Similarity
from dyngs.models.renderable import Surface

COUNT = 3000
BOX = LOW, HIGH


def ball(opacity: float = 6.0) -> StaticScene:
    """Small discs of the surface, red where x > 0, else blue."""
    k = torch.arange(COUNT) + 0.5
    height = 1 - 2 * k / COUNT
    angle = k * math.pi * (1 + 5**0.5)
    across = (1 - height.square()).sqrt()
    ways = torch.stack([across * angle.cos(), across * angle.sin(), height], 1)
    colours = torch.where(ways[:, :1] > 0, torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1]))
    # z to the normal
    quats = torch.cat([1 + ways[:, 2:], -ways[:, 1:2], ways[:, :1], torch.zeros(COUNT, 1)], 1)
    scales = torch.tensor([0.03, 0.03, 0.002]).log().repeat(COUNT, 1)
    sh = ((colours - 0.5) / SH_C0)[:, None]
    return StaticScene(
        gaussians=Gaussians(RADIUS * ways, quats, scales, torch.full((COUNT,), opacity), sh)
    )


def cameras() -> list[Cameras]:
    """Those of the ball with four times as many pixels along a side."""
    larger = torch.tensor([4.0, 4.0, 1.0])[:, None]
    seen = [one.camera for one in views()]
    return [
        Cameras(one.cam_from_world, one.intrinsics * larger, 4 * one.width, 4 * one.height)
        for one in seen
    ]


@cache
def surface() -> Surface:
    return extract_surface(ball(), cameras(), BOX, cells=30)


def volume(found: Surface | Mesh) -> float:
    """Signed volume, positive for outward-facing faces."""
    a, b, c = found.vertices[found.faces].transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6)


def test_a_ball_of_gaussians_has_the_surface_of_a_ball() -> None:
    radii = np.linalg.norm(surface().vertices, axis=1)
    assert abs(np.median(radii) - RADIUS) < 0.01
    assert np.quantile(np.abs(radii - RADIUS), 0.95) < 0.05
    assert volume(surface()) == pytest.approx(4 / 3 * math.pi * RADIUS**3, rel=0.05)
    assert count_holes(surface()) == 0
    sides = surface().vertices[:, 0]
    assert surface().colours[sides > 0.1, 0].min() > 0.7
    assert surface().colours[sides < -0.1, 2].min() > 0.7


@pytest.mark.parametrize("factor", [2.0**-20, 2.0**-13, 2.0**10])
def test_the_surface_is_the_same_in_any_unit(factor: float) -> None:
    """Up to rounding of the log scales."""
    whole = ball()
    options = replace(whole.options, near=factor * whole.options.near)
    scene = replace(whole, gaussians=scaled(whole.gaussians, factor), options=options)
    moved = [Similarity(scale=factor).cameras(one) for one in cameras()]
    found = extract_surface(scene, moved, (factor * LOW, factor * HIGH), cells=30)
    np.testing.assert_array_equal(found.faces, surface().faces)
    np.testing.assert_allclose(found.vertices / factor, surface().vertices, rtol=0, atol=1e-3)
    box = opaque_box(scene.gaussians)
    own = opaque_box(whole.gaussians)
    torch.testing.assert_close(torch.stack(box) / factor, torch.stack(own))


def test_surface_ends_at_unobserved_space() -> None:
    """Views from one side give half a ball with an open boundary."""
    half = fuse_depths(views()[:1], *BOX, 40, unseen_is_solid=False)
    assert half is not None
    assert count_holes(Surface(half.vertices, half.faces, half.vertices)) > 0
    assert half.vertices[:, 2].max() < 0.3
    np.testing.assert_allclose(np.linalg.norm(half.vertices, axis=1).mean(), RADIUS, atol=0.03)


def piece(center: tuple[float, float, float], count: int) -> tuple[Tensor, Tensor]:
    """A fan of ``count`` triangles."""
    angles = torch.arange(count + 1) / count * 5
    rim = torch.stack([angles.cos(), angles.sin(), torch.zeros(count + 1)], 1)
    corners = torch.cat([torch.zeros(1, 3), rim]) + torch.tensor(center)
    k = torch.arange(count)
    return corners, torch.stack([torch.zeros(count, dtype=torch.long), k + 1, k + 2], 1)


def test_small_components_are_removed() -> None:
    (large, first), (small, second) = piece((0, 0, 0), 200), piece((9, 0, 0), 2)
    mesh = Mesh(torch.cat([small, large]).numpy(), torch.cat([second, first + len(small)]).numpy())
    kept = keep_largest_components(mesh)
    assert kept.faces.shape == (200, 3)
    np.testing.assert_array_equal(kept.vertices[kept.faces], large.numpy()[first.numpy()])
    assert count_holes(Surface(kept.vertices, kept.faces, kept.vertices)) == 1
