"""Quadratic triangular Bezier patches: values at places on them, which of them images show, and
images of these.

P patches, N places, V views. A place is (u, v), w = 1 - u - v; control points (i, j, k), i + j + k
= 2, belong to u^i v^j w^k, in the order 200, 110, 101, 020, 011, 002 (csrc/math/bezier.hpp). The
boundary-aware weights of BG-Triangle (Wu et al. 2025), 1 inside, a half at an outline, 0 outside,
are those of pixels here, not of Gaussians on them: between two neighbours that show different
patches lies an outline, whose place says how much of each the other one covers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.ops.registration import Backward, check_size, empty_like, launch, register

NUM_POINTS = 6  # of a quadratic patch
SEGMENTS = 6  # Of an edge: 36 flat faces (Wu et al. 2025)
MOST_SEGMENTS = 64
NO_CROSSING = 0.5  # Between pixels neither of which covers any of the other


def lattice_size(segments: int) -> int:
    """Return the number of points of a triangular lattice with so many segments along an edge."""
    return (segments + 1) * (segments + 2) // 2


def lattice(segments: int) -> tuple[Tensor, Tensor]:
    """Return (K, 2) float64 places of a lattice's points, in their order, and (segments^2, 3)
    faces, facing alike."""
    uv = [
        (i / segments, j / segments)
        for i in range(segments, -1, -1)
        for j in range(segments - i, -1, -1)
    ]

    def index(i: int, j: int) -> int:
        row = segments - i
        return row * (row + 1) // 2 + row - j

    faces: list[tuple[int, int, int]] = []
    for i in range(segments):
        for j in range(segments - i):
            faces.append((index(i, j), index(i + 1, j), index(i, j + 1)))
            if i + j + 2 <= segments:
                faces.append((index(i + 1, j + 1), index(i, j + 1), index(i + 1, j)))
    return torch.tensor(uv, dtype=torch.float64, device="cpu"), torch.tensor(faces, device="cpu")


def _values(values: Tensor, ids: Tensor, uv: Tensor, basis: int) -> Tensor:
    out = values.new_empty(ids.shape[0], values.shape[2])
    launch(values, "patch_values_forward", uv, ids, values, basis, out)
    return out


def _values_backward(x: Backward) -> Sequence[Tensor]:
    values, ids, uv, basis = x.inputs
    (grad,) = x.grads
    by_values = empty_like(values)
    launch(grad, "patch_values_backward", uv, ids, grad, basis, by_values)
    return [by_values]


patch_values_op = register("patch_values", _values, _values_backward, "values")


def patch_values(values: Tensor, ids: Tensor, uv: Tensor, segments: int = 0) -> Tensor:
    """Return (N, C) values of patches at places on them, differentiable in ``values``; the same on
    any threads.

    Args:
        values: (P, K, C) of control points; with ``segments`` at the points of a lattice, linear
            between them.
        ids: (N,) int32 patch of each place.
        uv: (N, 2) places.
    """
    return patch_values_op(
        values.contiguous(), ids.contiguous(), uv.contiguous().to(values.dtype), segments
    )


@torch.no_grad()
def visible_patches(
    points: Tensor, cameras: Cameras, near: float, segments: int = SEGMENTS
) -> tuple[Tensor, Tensor]:
    """Return (V, H, W) int32 patch that each pixel shows, -1 for none, and (V, H, W, 2) where on
    it.

    A z-buffer of flat faces: perspective-correct, both sides, cut at ``near``; of several as near
    the first is shown. Patches with a point that is not finite are not. The same on any number of
    threads.

    Args:
        points: (P, 6, 3) control points, world.
        segments: of an edge; a patch is ``segments``^2 faces.
    """
    check_size(cameras.width, cameras.height)
    cameras = cameras.to(dtype=points.dtype)
    shape = len(cameras), cameras.height, cameras.width
    ids = torch.empty(shape, dtype=torch.int32, device=points.device)
    uv = points.new_empty(*shape, 2)
    given = points.contiguous(), *_arrays(cameras), segments, near
    launch(points, "visible_patches", *given, ids, uv)
    return ids, uv


def _arrays(cameras: Cameras) -> list[Tensor]:
    return [cameras.cam_from_world.contiguous(), cameras.intrinsics.contiguous()]


def _ends(
    points: Tensor,
    cameras: list[Tensor],
    views: Tensor,
    ids: Tensor,
    uv: Tensor,
    directions: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    found = torch.empty(ids.shape, dtype=torch.bool, device=ids.device)
    out = uv.new_empty(ids.shape), torch.empty_like(uv), torch.empty_like(uv)
    launch(points, "patch_ends", points, *cameras, uv, (views, ids, directions), found, out)
    return found, *out


patch_ends_op = register("patch_ends", _ends)
"""Whether and where patches end between places on them and the next pixels; ``cameras``: poses and
intrinsics."""


def _blend(
    means: Tensor, colours: Tensor, crossings: Tensor, rows: Tensor, ids: Tensor
) -> tuple[Tensor, Tensor]:
    out = colours.new_empty(*rows.shape, colours.shape[1]), colours.new_empty(rows.shape)
    launch(colours, "blend_patches_forward", colours, crossings, rows, ids, out)
    return out


def _blend_backward(x: Backward) -> Sequence[Tensor]:
    _, colours, crossings, *pixels = x.inputs
    out = colours.new_empty(len(colours), 2), empty_like(colours), empty_like(crossings)
    given = colours, crossings, *pixels, tuple(x.grads)
    launch(colours, "blend_patches_backward", *given, out)
    return out


blend_patches_op = register("blend_patches", _blend, _blend_backward, "means colours crossings")


@dataclass(frozen=True)
class PatchSamples:
    """The N places on patches that the pixels of V views show."""

    rows: Tensor  # (V, H, W) int32, which of them a pixel shows; -1: nothing
    ids: Tensor  # (N,) int32 patches
    uv: Tensor  # (N, 2)

    @staticmethod
    def of(ids: Tensor, uv: Tensor) -> PatchSamples:
        """Return the places of what ``visible_patches`` returned, view by view, row by row."""
        shown = ids >= 0
        rows = torch.where(shown, shown.flatten().cumsum(0).view(ids.shape) - 1, -1).to(torch.int32)
        return PatchSamples(rows, ids[shown], uv[shown])


@dataclass(frozen=True)
class ProjectedPoints:
    """Points of patches in an image, differentiable."""

    means: Tensor  # (N, 2) px
    depths: Tensor  # (N,)


def project_points(points: Tensor, cameras: Cameras, views: Tensor) -> ProjectedPoints:
    """Return where ``points`` (N, 3) of the world are in the images of ``views`` (N,)."""
    which = slice(0, 1) if len(cameras) == 1 else views
    pose = cameras.cam_from_world[which]
    inner = cameras.intrinsics[which]
    local = (
        points @ pose[0, :3, :3].T
        if len(cameras) == 1
        else (pose[:, :3, :3] * points[:, None]).sum(2)
    )
    x, y, z = (local + pose[:, :3, 3]).unbind(1)
    across = inner[:, 0, 0] * x / z + inner[:, 0, 2]
    down = inner[:, 1, 1] * y / z + inner[:, 1, 2]
    return ProjectedPoints(torch.stack([across, down], 1), z)


def outline_crossings(points: Tensor, cameras: Cameras, places: PatchSamples) -> Tensor:
    """Return (V, 2, H, W): how far from a pixel's centre to the next in its row, in its column,
    their outline is.

    ``NO_CROSSING`` where both show the same patch, where the outline runs rather along the row or
    column than across it, or where neither ends in between: then what shows is a fold. Where both
    end there it is the middle of the two ends. Differentiable in ``points`` (P, 6, 3).
    """
    views, height, width = places.rows.shape
    out = points.new_full((views, 2, height, width), NO_CROSSING)
    if not len(places.ids):
        return out
    pairs = [_differing(places, axis) for axis in (0, 1)]
    first, second, to = (torch.cat(parts) for parts in zip(*pairs, strict=True))
    axis = (to // (height * width)) % 2
    steps, found = _ends_between(
        points, cameras, places, torch.cat([first, second]), torch.cat([2 * axis, 2 * axis + 1])
    )
    (a, b), (of_a, of_b) = steps.view(2, -1), found.view(2, -1)
    middle = torch.where(of_b, 0.5 * (a + 1 - b), a)
    crossing = torch.where(of_a, middle, torch.where(of_b, 1 - b, NO_CROSSING))
    return out.view(-1).index_put((to,), crossing).view_as(out)


def _differing(places: PatchSamples, axis: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return indices of pixels that show another patch than the next along x (axis 0) or y, of
    those, of crossings."""
    rows = places.rows
    _, height, width = rows.shape
    labels = torch.where(rows >= 0, places.ids[rows.clamp_min(0).long()], -1)
    differs = torch.zeros(labels.shape, dtype=torch.bool, device=labels.device)
    if axis == 0:
        differs[:, :, :-1] = labels[:, :, 1:] != labels[:, :, :-1]
    else:
        differs[:, :-1] = labels[:, 1:] != labels[:, :-1]
    first = differs.view(-1).nonzero()[:, 0]
    return (
        first,
        first + (1, width)[axis],
        first + (first // (height * width) + axis) * (height * width),
    )


def _ends_between(
    points: Tensor, cameras: Cameras, places: PatchSamples, pixels: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor]:
    """Return (N,) steps in ``directions`` from ``pixels`` to where what they show ends, and (N,)
    whether it does."""
    rows = places.rows.view(-1)[pixels].long()
    ids = torch.where(rows >= 0, places.ids[rows.clamp_min(0)], -1)
    views = (pixels // places.rows[0].numel()).to(torch.int32)
    found, steps, uv, slopes = patch_ends_op(
        points.detach().contiguous(),
        _arrays(cameras),
        views,
        ids,
        places.uv[rows.clamp_min(0)].contiguous(),
        directions.to(torch.int32),
    )
    which = found.nonzero()[:, 0]
    edges = patch_values(points, ids[which], uv[which])
    means = project_points(edges, cameras, views[which].long()).means
    moved = steps[which] + ((means - means.detach()) * slopes[which]).sum(1)
    return steps.index_put((which,), moved), found


def blend_patches(
    means: Tensor, colours: Tensor, crossings: Tensor, places: PatchSamples
) -> tuple[Tensor, Tensor]:
    """Return (V, H, W, C) images before black and (V, H, W) transmittance, differentiable once.

    A pixel is the mean of what it and its four neighbours show, by how much each covers: of a pixel
    and the next one, with an outline t steps from the first (``crossings``), max(0, 1/2 - t) of the
    first are the second's, and max(0, t - 1/2) of the second the first's. Where neighbours would
    cover more than all of a pixel their shares are scaled to it. The same bits on any number of
    threads.

    Args:
        means: (N, 2) px, of the places, which are at the centres of their pixels: not read. Their
            gradient is that of moving what a patch shows along the image, by differences of
            neighbours on the same patch.
        colours: (N, C).
        crossings: (V, 2, H, W), see ``outline_crossings``.
    """
    return blend_patches_op(
        means.contiguous(), colours.contiguous(), crossings.contiguous(), places.rows, places.ids
    )
