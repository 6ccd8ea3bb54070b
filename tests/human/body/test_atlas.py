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
from scipy.spatial import Delaunay
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


def cube(turned_diagonals: int) -> BodyTemplate:
    """The cube [0, 1]^3, each side a third of the atlas' width and half of its height; 6 bits turn
    its diagonals."""
    vertices = torch.tensor(list(product((0.0, 1.0), repeat=3)))
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = []
    uv_faces = []
    uv = []
    for k, side in enumerate(sides):
        place = torch.tensor([k % 3, k // 3])
        uv += [
            (place + torch.tensor(c)) / torch.tensor([3.0, 2])
            for c in ((0, 0), (1, 0), (1, 1), (0, 1))
        ]
        for corners in (
            ((0, 1, 2), (0, 2, 3)) if turned_diagonals >> k & 1 else ((0, 1, 3), (1, 2, 3))
        ):
            faces.append([side[c] for c in corners])
            uv_faces.append([4 * k + c for c in corners])
    return body_of(vertices, torch.tensor(faces), torch.stack(uv), torch.tensor(uv_faces))


def centres(texels: Texels) -> Tensor:
    """(P, 2) uv of the texels' centres."""
    row = texels.index // texels.resolution
    column = texels.index % texels.resolution
    return torch.stack(
        [(column + 0.5) / texels.resolution, 1 - (row + 0.5) / texels.resolution], dim=1
    )


def face_normals(body: BodyTemplate, faces: Tensor) -> Tensor:
    corners = body.vertices[body.faces[faces]].double()
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=-1)
    return torch.nn.functional.normalize(cross, dim=-1)


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


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([7, 16, 30]))
def test_a_triangulated_square_has_neither_holes_nor_overlap(seed: int, resolution: int) -> None:
    """Of any triangles; centres are blends of their corners."""
    points = np.random.default_rng(seed).random((20, 2))
    uv = np.concatenate(
        [points, [[0, 0], [1, 0], [1, 1], [0, 1]], np.round(points * resolution) / resolution]
    )
    uv = np.unique(uv.astype(np.float32), axis=0)
    faces = torch.from_numpy(Delaunay(uv).simplices).long()
    texels = atlas_texels(sheet(torch.from_numpy(uv), faces), resolution)
    assert torch.equal(texels.index, torch.arange(resolution**2))
    fractions = texels.barycentric
    assert float(fractions.min()) >= 0
    torch.testing.assert_close(fractions.sum(1), torch.ones(len(texels)), rtol=0, atol=2e-7)
    blended = (fractions[..., None] * torch.from_numpy(uv)[faces[texels.faces]]).sum(1)
    torch.testing.assert_close(blended, centres(texels), rtol=0, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.floats(0, 1), st.integers(0, 6), st.integers(0, 6))
def test_no_texel_is_lost_on_a_shared_edge(start: float, column: int, row: int) -> None:
    """An edge across the atlas that meets a centre up to rounding: one side or the other has the
    texel."""
    u = (column + 0.5) / 7
    v = 1 - (row + 0.5) / 7
    end = start + (v - start) / u
    uv = torch.tensor(
        [[0.0, -9], [1, -9], [0, start], [1, end], [0, 9], [1, 9]], dtype=torch.float64
    )
    texels = atlas_texels(sheet(uv, torch.tensor([[0, 1, 3], [0, 3, 2], [2, 3, 5], [2, 5, 4]])), 7)
    assert torch.equal(texels.index, torch.arange(49))


def test_the_first_row_is_at_the_top() -> None:
    """v grows upwards: the upper left texel is that at u = 0, v = 1."""
    body = sheet(torch.tensor([[0.0, 1], [0, 0.75], [0.25, 1]]), torch.tensor([[0, 1, 2]]))
    assert atlas_texels(body, 4).index.tolist() == [0]
    assert atlas_texels(body, 8).index.tolist() == [0, 1, 8]


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


def test_a_skewed_atlas_keeps_the_tangent_along_u() -> None:
    """x = 3 u - v, y = 2 v: u grows along +x where v is constant; area 6 of the unit square."""
    body = square()
    x, y, z = body.vertices.unbind(1)
    texels = atlas_texels(body, 4, vertices=torch.stack([3 * x - y, 2 * y, z], dim=1))
    torch.testing.assert_close(texels.frames, torch.eye(3).expand(16, 3, 3))
    torch.testing.assert_close(texels.size, torch.full((16,), math.sqrt(6) / 4))


def test_mirrored_texture_has_right_handed_frames_all_the_same() -> None:
    """Only the tangent and the bitangent turn round."""
    texels = atlas_texels(square(flipped=True), 8)
    expected = torch.diag(torch.tensor([-1.0, -1, 1])).expand(64, 3, 3)
    torch.testing.assert_close(texels.frames, expected)
    torch.testing.assert_close(texels.points[:, 0], 1 - centres(texels)[:, 0])


@pytest.mark.parametrize("turned_diagonals", [0, 0b111111, 0b010011])
def test_cube(turned_diagonals: int) -> None:
    """Normals at corners are diagonal however its sides are cut; elsewhere they are blends; areas
    are exact."""
    body = cube(turned_diagonals)
    texels = atlas_texels(body, 24)
    assert len(texels) == 24 * 24
    around = body.faces[texels.faces]
    corners = 2 * body.vertices[around] - 1
    blended = (texels.barycentric[..., None] * corners).sum(1)
    expected = torch.nn.functional.normalize(blended, dim=1)
    torch.testing.assert_close(texels.normals, expected, rtol=0, atol=1e-6)
    assert bool(((texels.normals * face_normals(body, texels.faces).float()).sum(1) > 0.5).all())
    torch.testing.assert_close(texels.points, 0.5 * (blended + 1), rtol=0, atol=1e-6)
    assert_frames(texels)
    assert float(texels.size.square().sum()) == pytest.approx(6)


def test_a_sheet_with_two_sides_has_the_normals_of_its_faces() -> None:
    """Its smooth normals cancel."""
    uv = torch.tensor([[0.0, 0], [0.5, 0], [0, 0.5], [1, 1], [0.5, 1], [1, 0.5]])
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    body = body_of(
        vertices, torch.tensor([[0, 1, 2], [0, 2, 1]]), uv, torch.tensor([[0, 1, 2], [3, 4, 5]])
    )
    texels = atlas_texels(body, 8)
    assert set(texels.faces.tolist()) == {0, 1}
    expected = torch.tensor([[0.0, 0, 1], [0, 0, -1]])[texels.faces]
    torch.testing.assert_close(texels.normals, expected)
    assert_frames(texels)


def test_a_normal_along_the_tangent_still_has_a_frame() -> None:
    """A sheet with two sides, whose own normals cancel, and at each corner a fin that looks along
    x, as u grows."""
    sides = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    fins = (sides[:, None] + torch.tensor([[0.0, 1, 0], [0, 0, 1]])).reshape(6, 3)
    faces = torch.tensor([[0, 1, 2], [0, 2, 1], [0, 3, 4], [1, 5, 6], [2, 7, 8]])
    uv_faces = torch.tensor([[0, 1, 2], [3, 3, 3], [3, 3, 3], [3, 3, 3], [3, 3, 3]])
    uv = torch.cat([sides[:, :2], torch.zeros(1, 2)])
    texels = atlas_texels(body_of(torch.cat([sides, fins]), faces, uv, uv_faces), 8)
    assert set(texels.faces.tolist()) == {0}
    torch.testing.assert_close(texels.normals, torch.tensor([1.0, 0, 0]).expand(len(texels), 3))
    assert_frames(texels)


def test_a_larger_person_has_larger_texels() -> None:
    """The rest shape may be another than the template's."""
    body = default_template()
    usual = anny(64)
    large = atlas_texels(body, 64, vertices=2 * body.vertices)
    assert torch.equal(large.index, usual.index)
    torch.testing.assert_close(large.points, 2 * usual.points)
    torch.testing.assert_close(large.size, 2 * usual.size)
    torch.testing.assert_close(large.frames, usual.frames, rtol=0, atol=1e-5)
    torch.testing.assert_close(large.weights, usual.weights)


def test_what_cannot_be_done() -> None:
    body = square()
    with pytest.raises(DyngsError, match="'test' has no texture coordinates"):
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


def test_texels_lie_on_their_faces_which_look_outwards() -> None:
    """Smooth normals differ from those of faces, but nowhere by 90 degrees."""
    body = default_template()
    texels = anny(256)
    flat = face_normals(body, texels.faces)
    corner = body.vertices[body.faces[texels.faces, 0]].double()
    above = ((texels.points.double() - corner) * flat).sum(1)
    assert float(above.abs().max()) < 2e-7
    corners = body.vertices[body.faces[texels.faces]]
    blended = (texels.barycentric[..., None] * corners).sum(1)
    torch.testing.assert_close(texels.points, blended, rtol=0, atol=5e-7)
    agreement = (flat * texels.normals.double()).sum(1)
    assert float(agreement.min()) > 0.1
    assert float(agreement.mean()) > 0.98


def test_squares_of_the_sizes_add_up_to_the_surface() -> None:
    body = default_template()
    corners = body.vertices[body.faces].double()
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=-1)
    area = 0.5 * float(cross.norm(dim=1).sum())
    assert area == pytest.approx(1.947, abs=1e-3)
    assert float(anny(512).size.double().square().sum()) == pytest.approx(area, rel=2e-4)
    assert float(anny(256).size.double().square().sum()) == pytest.approx(area, rel=2e-3)


# --- shells
# -----------------------------------------------------------------------------------------------------------


# --- neighbours
# -------------------------------------------------------------------------------------------------------
