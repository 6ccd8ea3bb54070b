"""Texels on the surface of a template: which triangle has them, where they lie, and what lies above
them."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.human.body.atlas import Texels, atlas_texels
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import default_template

NUM_JOINTS = 2


def body_of(
    vertices: Tensor, faces: Tensor, uv: Tensor, uv_faces: Tensor | None = None
) -> BodyTemplate:
    """A template with two joints; the fraction of the second grows with x, from 0 at x = 0 to 1 at
    x = 1."""
    fraction = vertices[:, :1]
    return BodyTemplate(
        name="test",
        vertices=vertices,
        faces=faces,
        uv=uv,
        uv_faces=faces if uv_faces is None else uv_faces,
        weights=torch.cat([1 - fraction, fraction], dim=1),
        parents=(-1, 0),
        joints=torch.zeros(NUM_JOINTS, 3),
    )


def sheet(uv: Tensor, faces: Tensor) -> BodyTemplate:
    """The part of the plane z = 0.25 whose texture is itself, facing +z where ``faces`` are
    counter-clockwise."""
    return body_of(torch.cat([uv, torch.full((len(uv), 1), 0.25)], dim=1), faces, uv)


def square(flipped: bool = False) -> BodyTemplate:
    """A square of side 1 of two triangles; its texture upright or mirrored."""
    corners = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    body = sheet(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]))
    return (
        replace(body, uv=corners * torch.tensor([-1.0, 1]) + torch.tensor([1.0, 0]))
        if flipped
        else body
    )


def centres(texels: Texels) -> Tensor:
    """(P, 2) uv of the texels' centres."""
    row = texels.index // texels.resolution
    column = texels.index % texels.resolution
    return torch.stack(
        [(column + 0.5) / texels.resolution, 1 - (row + 0.5) / texels.resolution], dim=1
    )


def assert_frames(texels: Texels) -> None:
    frames = texels.frames.double()
    identity = torch.eye(3, dtype=torch.float64).expand_as(frames)
    torch.testing.assert_close(frames.mT @ frames, identity, rtol=0, atol=1e-6)
    assert bool((torch.linalg.det(frames) > 0).all())


@cache
def anny(resolution: int) -> Texels:
    """Texels of the shipped template."""
    return atlas_texels(default_template(), resolution)


# --- which triangle has a texel
# ---------------------------------------------------------------------------------------


def first_triangle(corners: np.ndarray, column: int, row: int, resolution: int) -> int | None:
    """The first of the triangles (T, 3, 2), in 64ths of the atlas' side, that holds the centre; in
    whole numbers."""
    centre = (64 * (2 * column + 1), 64 * (2 * (resolution - row) - 1))
    for number, triangle in enumerate((2 * resolution * corners).tolist()):
        turns = []
        for k in range(3):
            a = triangle[k]
            b = triangle[(k + 1) % 3]
            turns.append((b[0] - a[0]) * (centre[1] - a[1]) - (b[1] - a[1]) * (centre[0] - a[0]))
        (ax, ay), (bx, by), (cx, cy) = triangle
        if (bx - ax) * (cy - ay) != (by - ay) * (cx - ax) and (min(turns) >= 0 or max(turns) <= 0):
            return number
    return None


@settings(max_examples=60, deadline=None)
@given(arrays(np.int64, (4, 3, 2), elements=st.integers(-8, 72)), st.sampled_from([1, 2, 4, 8]))
def test_the_first_triangle_that_holds_the_centre_has_the_texel(
    corners: np.ndarray, resolution: int
) -> None:
    """On a grid on which centres lie on edges and corners; triangles overlap, are degenerate, or
    leave the atlas."""
    uv = torch.from_numpy(corners.reshape(-1, 2) / 64).float()
    body = body_of(
        torch.rand(12, 3, generator=torch.Generator().manual_seed(0)),
        torch.arange(12).reshape(4, 3),
        uv,
    )
    texels = atlas_texels(body, resolution)
    found = dict(zip(texels.index.tolist(), texels.faces.tolist(), strict=True))
    expected = {}
    for row, column in product(range(resolution), repeat=2):
        number = first_triangle(corners, column, row, resolution)
        if number is not None:
            expected[row * resolution + column] = number
    assert found == expected
    assert list(found) == sorted(found)
    assert_frames(texels)


def test_degenerate_triangles_cover_nothing() -> None:
    """In the atlas, or on the surface: there the neighbour has the shared edge, and nobody the
    inside."""
    body = square()
    assert body.uv is not None
    flat = body.vertices.clone()
    flat[1] = flat[0]
    texels = atlas_texels(body, 4, vertices=flat)
    assert texels.index.tolist() == [0, 1, 2, 3, 4, 5, 6, 8, 9, 12]
    assert set(texels.faces.tolist()) == {1}
    uv = body.uv.clone()
    uv[1] = 0.5 * (uv[0] + uv[2])
    assert torch.equal(atlas_texels(replace(body, uv=uv), 4).index, texels.index)
    sliver = uv.double()
    sliver[1, 0] += 1e-11
    assert set(atlas_texels(replace(body, uv=sliver), 4).faces.tolist()) == {1}
    uv[1] = math.nan
    assert torch.equal(atlas_texels(replace(body, uv=uv), 4).index, texels.index)


# --- where it lies on the surface
# -------------------------------------------------------------------------------------


def test_on_a_plane_everything_is_known() -> None:
    texels = atlas_texels(square(), 8)
    u, v = centres(texels).unbind(1)
    assert len(texels) == 64
    torch.testing.assert_close(texels.points, torch.stack([u, v, torch.full((64,), 0.25)], dim=1))
    torch.testing.assert_close(texels.weights, torch.stack([1 - u, u], dim=1))
    torch.testing.assert_close(texels.frames, torch.eye(3).expand(64, 3, 3))
    torch.testing.assert_close(texels.size, torch.full((64,), 1 / 8))


def test_mirrored_texture_has_right_handed_frames_all_the_same() -> None:
    """Only the tangent and the bitangent turn round."""
    texels = atlas_texels(square(flipped=True), 8)
    expected = torch.diag(torch.tensor([-1.0, -1, 1])).expand(64, 3, 3)
    torch.testing.assert_close(texels.frames, expected)
    torch.testing.assert_close(texels.points[:, 0], 1 - centres(texels)[:, 0])


def test_invalid_atlas_arguments_are_refused() -> None:
    body = square()
    with pytest.raises(DyngsError, match="'test' has no UV map"):
        atlas_texels(replace(body, uv=None, uv_faces=None), 8)
    with pytest.raises(DyngsError, match="at least 1, got 0"):
        atlas_texels(body, 0)
    with pytest.raises(DyngsError, match=r"must be \(4, 3\) finite numbers, got \(5, 3\)"):
        atlas_texels(body, 8, vertices=torch.zeros(5, 3))
    with pytest.raises(DyngsError, match="NaN"):
        atlas_texels(body, 8, vertices=torch.full((4, 3), math.nan))


# --- the shipped template
# ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("resolution", "count"), [(256, 40_994), (512, 163_992)])
def test_texels_of_the_template(resolution: int, count: int) -> None:
    texels = anny(resolution)
    assert len(texels) == count
    assert bool((texels.index.diff() > 0).all())
    fractions = texels.barycentric
    sums = texels.weights.double().sum(1)
    assert float(fractions.min()) >= 0
    assert float(fractions.max()) <= 1
    torch.testing.assert_close(sums, torch.ones_like(sums), rtol=0, atol=5e-7)
    assert_frames(texels)


# --- shells
# ----------------------------------------------------------------------------------------------


# --- neighbours
# ----------------------------------------------------------------------------------------------
