"""Curved triangles as a mesh of flat ones, for other programs."""

from __future__ import annotations

import torch

from dyngs.baselines.triangles.patches import evaluated
from dyngs.baselines.triangles.scene import TriangleScene
from dyngs.models.renderable import Surface
from dyngs.ops.patches import MOST_SEGMENTS, SEGMENTS, lattice


@torch.no_grad()
def surface_of(scene: TriangleScene, segments: int | None = None) -> Surface:
    """Return the surface: of each triangle ``segments``^2 flat ones, with the colours without
    harmonics.

    Triangles do not share vertices, as they do not in the scene. ``segments``: None: as the scene
    is drawn, or as many as its textures need.
    """
    patches = scene.patches
    count = max(SEGMENTS, patches.texture) if segments is None else min(segments, MOST_SEGMENTS)
    places, faces = lattice(count)
    vertices = evaluated(patches.points, places)
    ids = torch.arange(len(patches), dtype=torch.int32, device="cpu").repeat_interleave(len(places))
    colours = patches.colours_at(ids, places.to(vertices.dtype).repeat(len(patches), 1))
    first = torch.arange(len(patches), device="cpu")[:, None, None] * len(places)
    flat = (faces + first).flatten(0, 1)
    return Surface(vertices.flatten(0, 1).numpy(), flat.numpy(), colours.clamp(0, 1).numpy())
