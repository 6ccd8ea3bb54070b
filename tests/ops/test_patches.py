"""Bezier patches: values, what images show, and blending, against plain torch in float64 and known
answers."""

from __future__ import annotations

import math

import pytest
import torch
from patch_reference import reference_blend, reference_values, reference_visible
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.ops.patches import (
    PatchSamples,
    blend_patches,
    lattice,
    lattice_size,
    outline_crossings,
    patch_values,
    project_points,
    visible_patches,
)


def camera(width: int = 24, height: int = 18, distance: float = 3.0, views: int = 1) -> Cameras:
    """Looking along z from ``distance`` in front of the origin."""
    pose = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    pose[:, 2, 3] = distance
    pose[:, 0, 3] = torch.linspace(0, 0.4, views, dtype=torch.float64) if views > 1 else 0.0
    inner = torch.tensor(
        [[20.0, 0, width / 2], [0, 21.0, height / 2], [0, 0, 1]], dtype=torch.float64
    )
    return Cameras(pose, inner.repeat(views, 1, 1), width, height)


def random_patches(count: int, seed: int = 0, size: float = 0.6) -> Tensor:
    """(P, 6, 3) around the origin, bent at random."""
    generator = torch.Generator().manual_seed(seed)
    middle = torch.rand(count, 1, 3, generator=generator, dtype=torch.float64) * 1.6 - 0.8
    return middle + size * torch.randn(count, 6, 3, generator=generator, dtype=torch.float64)


def flat(*corners: tuple[float, float, float]) -> Tensor:
    """(1, 6, 3) a flat triangle."""
    a, b, c = torch.tensor(corners, dtype=torch.float64)
    return torch.stack([a, (a + b) / 2, (a + c) / 2, b, (b + c) / 2, c])[None]


def random_places(count: int, patches: int, seed: int = 1) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    uv = torch.rand(count, 2, generator=generator, dtype=torch.float64)
    uv = torch.where(uv.sum(1, keepdim=True) > 1, 1 - uv, uv)
    return torch.randint(patches, (count,), generator=generator, dtype=torch.int32), uv


def test_values_are_those_of_bernstein_polynomials() -> None:
    values = random_patches(5).requires_grad_()
    ids, uv = random_places(40, 5)
    found = patch_values(values, ids, uv)
    expected = reference_values(values, ids, uv)
    torch.testing.assert_close(found, expected)
    grad = torch.randn_like(found)
    torch.testing.assert_close(
        *(torch.autograd.grad(x, values, grad)[0] for x in (found, expected))
    )


@pytest.mark.parametrize("segments", [1, 2, 5])
def test_a_lattice_is_linear_between_its_points(segments: int) -> None:
    places, faces = lattice(segments)
    assert places.shape == (lattice_size(segments), 2)
    assert faces.shape == (segments**2, 3)
    values = torch.randn(2, len(places), 3, dtype=torch.float64).requires_grad_()
    ids = torch.ones(len(places), dtype=torch.int32)
    torch.testing.assert_close(patch_values(values, ids, places, segments), values[1])
    middles = places[faces].mean(1)
    found = patch_values(values, torch.zeros(len(faces), dtype=torch.int32), middles, segments)
    torch.testing.assert_close(found, values[0][faces].mean(1))
    some, uv = random_places(30, 2)
    assert torch.autograd.gradcheck(lambda x: patch_values(x, some, uv, segments), values)


def test_lattice_faces_are_oriented_alike_and_cover_it() -> None:
    places, faces = lattice(6)
    a, b, c = places[faces].unbind(1)
    areas = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    torch.testing.assert_close(areas, torch.full((36,), 1 / 72, dtype=torch.float64))


@pytest.mark.parametrize("seed", range(3))
def test_pixels_show_the_nearest_patch(seed: int) -> None:
    points = random_patches(4, seed)
    cameras = camera(12, 9, 2.0, views=2)
    ids, uv = visible_patches(points, cameras, 0.7, 2)
    expected, places, _ = reference_visible(points, cameras, 0.7, 2)
    torch.testing.assert_close(ids, expected)
    assert (ids >= 0).any()
    torch.testing.assert_close(uv, places)


def test_visible_points_project_to_their_pixels() -> None:
    """A slanted flat patch: perspective-correct places, on the rays of the pixels' centres."""
    cameras = camera()
    points = flat((-1, -0.8, -1), (1, -0.5, 2), (0, 0.9, 0))
    ids, uv = visible_patches(points, cameras, 0.2)
    places = PatchSamples.of(ids, uv)
    assert len(places.ids) > 30
    x, y, z = patch_values(points, places.ids, places.uv).unbind(1)
    rows = (ids[0] >= 0).nonzero()
    torch.testing.assert_close(20 * x / (z + 3) + 12, rows[:, 1].double() + 0.5)
    torch.testing.assert_close(21 * y / (z + 3) + 9, rows[:, 0].double() + 0.5)


def test_adjacent_patches_leave_no_gap() -> None:
    corners = [(-1.0, -1.0, 0.3), (1.0, -1.0, -0.2), (1.0, 1.0, 0.1), (-1.0, 1.0, 0.0)]
    both = torch.cat(
        [flat(corners[0], corners[1], corners[2]), flat(corners[0], corners[2], corners[3])]
    )
    for width in (17, 24, 33):
        ids, _ = visible_patches(
            both.float(), camera(width, width, 3.2).to(dtype=torch.float32), 0.2
        )
        inside = ids[0, width // 3 : -(width // 3), width // 3 : -(width // 3)]
        assert (inside >= 0).all()


def test_invalid_patches_are_not_rendered() -> None:
    """All points equal, collinear, behind the camera, nearer than near, not a number, infinite."""
    point = flat((0, 0, 0), (0, 0, 0), (0, 0, 0))
    line = flat((-1, 0, 0), (0, 0, 0), (1, 0, 0))
    behind = flat((-1, -1, -4), (1, -1, -4), (0, 1, -5))
    near = flat((-1, -1, -2.9), (1, -1, -2.9), (0, 1, -2.9))
    patch = flat((-1, -1, 0), (1, -1, 0), (0, 1, 0))
    nan = patch.clone()
    infinite = patch.clone()
    nan[0, 4, 1] = math.nan
    infinite[0, 2, 0] = math.inf
    ids, uv = visible_patches(torch.cat([point, line, behind, near, nan, infinite]), camera(), 0.2)
    assert (ids == -1).all()
    assert uv.isfinite().all()


def test_a_patch_through_the_near_plane_is_cut_there() -> None:
    """Larger than all that is seen, from behind the camera to far away: a floor below it."""
    floor = flat((-1e4, 1, -1e4), (1e4, 1, -1e4), (0, 1, 2e4))
    cameras = camera()
    ids, uv = visible_patches(floor, cameras, 2.5)
    rows = (ids[0] >= 0).any(1).nonzero().flatten()
    assert rows.tolist() == list(range(9, 17))  # z = 21 / (y + 0.5 - 9), at least 2.5
    assert ((uv >= 0) & (uv <= 1)).all()


def some_image(
    seed: int, views: int = 1, width: int = 14, height: int = 11
) -> tuple[Tensor, Tensor, Tensor, PatchSamples]:
    """Means, colours of two channels, crossings anywhere, and the places of pixels that show one of
    three patches."""
    ids, uv = visible_patches(random_patches(3, seed, 0.5), camera(width, height, views=views), 0.2)
    places = PatchSamples.of(ids, uv)
    generator = torch.Generator().manual_seed(seed)
    means = (ids >= 0).nonzero()[:, [2, 1]] + 0.5
    colours = torch.rand(len(means), 2, generator=generator, dtype=torch.float64)
    crossings = torch.rand(views, 2, height, width, generator=generator, dtype=torch.float64)
    return (
        means.double().requires_grad_(),
        colours.requires_grad_(),
        crossings.requires_grad_(),
        places,
    )


@pytest.mark.parametrize(("seed", "views"), [(0, 1), (1, 2), (2, 1)])
def test_patch_blending_equals_reference(seed: int, views: int) -> None:
    means, colours, crossings, places = some_image(seed, views)
    found = blend_patches(means, colours, crossings, places)
    expected = reference_blend(colours, crossings, places)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)
    grads = [torch.randn_like(x) for x in found]
    for one, other in zip(
        torch.autograd.grad(found, (colours, crossings), grads),
        torch.autograd.grad(expected, (colours, crossings), grads),
        strict=True,
    ):
        assert other.abs().max() > 0
        torch.testing.assert_close(one, other)


def drawn(points: Tensor, cameras: Cameras, colours: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Images of patches, whose control points have ``colours`` (P, 6, C), and transmittance."""
    places = PatchSamples.of(*visible_patches(points.detach(), cameras, 0.2))
    views = (places.rows >= 0).nonzero()[:, 0]
    means = project_points(patch_values(points, places.ids, places.uv), cameras, views).means
    shown = torch.ones(len(places.ids), 1, dtype=points.dtype)
    if colours is not None:
        shown = patch_values(colours, places.ids, places.uv)
    return blend_patches(means, shown, outline_crossings(points, cameras, places), places)


@pytest.mark.parametrize("turn", [0.0, 0.4, 1.1, 2.0])
def test_an_outline_covers_the_area_that_it_encloses(turn: float) -> None:
    """To a hundredth of a pixel for each that it crosses, and at each corner a part of one."""
    angles = turn + torch.arange(3, dtype=torch.float64) * 2.0943951
    points = flat(*[(float(a.cos()), float(a.sin()), 0.0) for a in angles])
    image, through = drawn(points, camera().scaled(3))
    torch.testing.assert_close(image[..., 0] + through, torch.ones_like(through))
    crossed = int(((image > 0) & (image < 1)).sum())
    assert abs(float(image.sum()) - 0.75 * 3**0.5 * 20 * 21) < 0.01 * crossed + 1


def test_nearer_patch_covers_the_farther_along_its_outline() -> None:
    """A strip before a wall: only the strip's edges are outlines, and only they get a gradient."""
    wall = flat((-9, -9, 1), (9, -9, 1), (0, 18, 1))
    strip = flat((-0.4, -9, 0), (0.41, 0, 0), (-0.4, 9, 0))
    points = torch.cat([wall, strip]).requires_grad_()
    colours = torch.stack([torch.zeros(6, 1), torch.ones(6, 1)]).double()
    image, through = drawn(points, camera(), colours)
    assert (through == 0).all()
    (by_points,) = torch.autograd.grad(image.sum(), points)
    assert (by_points[0] == 0).all()
    assert by_points[1, 3, 0] > 1


@pytest.mark.parametrize("seed", range(3))
def test_gradient_equals_finite_differences_of_rendering(seed: int) -> None:
    """Of whole images by control points, against differences: outlines move, and colours move
    along."""
    points = random_patches(1, seed + 7, 0.1) * 0.2
    points = points + flat((-0.8, -0.7, 0.2), (0.9, -0.3, 0), (-0.2, 0.8, -0.1))
    colours = torch.linspace(0, 1, 6, dtype=torch.float64).view(1, 6, 1) * 0.4 + 0.5
    cameras = camera(48, 36).scaled(6)
    ramp = torch.linspace(0.5, 1.5, cameras.width, dtype=torch.float64)[:, None]

    def total(x: Tensor) -> Tensor:
        return (drawn(x, cameras, colours)[0] * ramp).sum() / 36

    leaf = points.clone().requires_grad_()
    (found,) = torch.autograd.grad(total(leaf), leaf)
    step = 2e-2
    slopes = torch.zeros_like(points)
    for i in range(6):
        for axis in range(3):
            moved = torch.zeros_like(points)
            moved[0, i, axis] = step
            slopes[0, i, axis] = (total(points + moved) - total(points - moved)) / (2 * step)
    error = (found - slopes).norm() / slopes.norm()
    assert error < 0.1, (error, found, slopes)
