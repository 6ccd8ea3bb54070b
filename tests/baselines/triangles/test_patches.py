"""Curved triangles: sizes, subdivision, textures, and validation of files."""

from __future__ import annotations

import math

import pytest
import torch
from small_triangles import bent

from dyngs.baselines.triangles.scene import Patches, evaluate_patches, subdivide
from dyngs.core.state import strip_roles
from dyngs.ops.patches import lattice, patch_values


def test_quarters_are_the_same_surface() -> None:
    """Every point of a quarter equals the point of the whole patch at the same coordinates."""
    points = bent(2).points.double()
    parts = subdivide(points)
    assert parts.shape == (8, 6, 3)
    places, faces = lattice(2)
    inner = lattice(4)[0]
    third = 1 - inner.sum(1, keepdim=True)
    for n, face in enumerate(faces):
        a, b, c = places[face]
        at = inner[:, :1] * a + inner[:, 1:] * b + third * c
        torch.testing.assert_close(
            evaluate_patches(parts[n::4], inner), evaluate_patches(points, at)
        )


def test_texture_starts_with_control_point_colours() -> None:
    patches = bent(3)
    with_texture = patches.with_texture(4)
    places, _ = lattice(4)
    ids = torch.arange(3, dtype=torch.int32).repeat_interleave(len(places))
    uv = places.float().repeat(3, 1)
    torch.testing.assert_close(
        with_texture.colours_at(ids, uv), patch_values(patches.colours, ids, uv)
    )
    assert with_texture.texture == 4


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("texture", torch.tensor([40])),
        ("texture", torch.tensor([2])),
        ("points", torch.zeros(4, 5, 3)),
        ("points", torch.full((4, 6, 3), math.nan)),
        ("colours", torch.zeros(3, 10, 3)),
        ("harmonics", torch.zeros(4, 2, 3)),
    ],
)
def test_mismatched_tensors_are_refused(name: str, value: torch.Tensor) -> None:
    stored = strip_roles(bent(4).with_texture(3).state())
    with pytest.raises(ValueError, match=r"'\w+'"):
        Patches.from_state(stored | {name: value})
