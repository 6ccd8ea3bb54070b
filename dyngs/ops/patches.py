"""Quadratic triangular Bezier patches: evaluation, visibility and anti-aliased rendering.

P patches, N samples, V views. A sample has patch coordinates (u, v), w = 1 - u - v. Control point
(i, j, k), i + j + k = 2, has the monomial u^i v^j w^k. Their order is 200, 110, 101, 020, 011, 002
(csrc/math/bezier.hpp).

Boundary-aware weights as in BG-Triangle (Wu et al. 2025) are computed per pixel here. An outline
lies between two neighbouring pixels that show different patches. Its position gives the fraction
of each pixel that the other patch covers.
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
NO_CROSSING = 0.5  # Between pixels neither of which covers any of the other


def lattice_size(segments: int) -> int:
    """Return the number of points of a triangular lattice with ``segments`` per edge."""
    return (segments + 1) * (segments + 2) // 2


def lattice(segments: int) -> tuple[Tensor, Tensor]:
    """Return (K, 2) float64 coordinates of a lattice's points and its (segments^2, 3) faces."""
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
    """Return (N, C) values interpolated on patches, differentiable in ``values``; deterministic.

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
    """Return (V, H, W) int32 ids of visible patches, -1 for none, and (V, H, W, 2) coordinates on
    them.

    A z-buffer of flat two-sided faces, perspective-correct and clipped at ``near``. Ties show the
    first patch. Patches with non-finite points are skipped. Results do not depend on the number of
    threads.

    Args:
        points: (P, 6, 3) control points, world.
        segments: per edge; a patch has ``segments``^2 faces.
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
    """N samples on patches, one per covered pixel of V views."""

    rows: Tensor  # (V, H, W) int32, which of them a pixel shows; -1: nothing
    ids: Tensor  # (N,) int32 patches
    uv: Tensor  # (N, 2)

    @staticmethod
    def of(ids: Tensor, uv: Tensor) -> PatchSamples:
        """Return the samples of ``visible_patches``'s output, ordered by view and row."""
        shown = ids >= 0
        rows = torch.where(shown, shown.flatten().cumsum(0).view(ids.shape) - 1, -1).to(torch.int32)
        return PatchSamples(rows, ids[shown], uv[shown])


@dataclass(frozen=True)
class ProjectedPoints:
    """Patch samples projected into an image, differentiable."""

    means: Tensor  # (N, 2) px
    depths: Tensor  # (N,)


def project_points(points: Tensor, cameras: Cameras, views: Tensor) -> ProjectedPoints:
    """Project ``points`` (N, 3) in world units into the images of ``views`` (N,)."""
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
    """Return (V, 2, H, W) distances to the outline between a pixel and its next row or column
    neighbour.

    ``NO_CROSSING`` if both show the same patch, if the outline is nearly parallel to that
    direction, or if no patch ends in between (a fold). If both patches end there, the mean of both
    ends. Differentiable in ``points`` (P, 6, 3).
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
    """Return indices of pixels whose next neighbour along x (axis 0) or y shows another patch, of
    these neighbours, and of the crossings.
    """
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
    """Return (N,) steps along ``directions`` from ``pixels`` to the patch outline, and (N,)
    validity.
    """
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
    """Return (V, H, W, C) images on black and (V, H, W) transmittance, differentiable once.

    A pixel is the mean of itself and its four neighbours, weighted by coverage. For an outline t
    steps from the first of two neighbours (``crossings``), the second covers max(0, 1/2 - t) of
    the first, and the first covers max(0, t - 1/2) of the second. Weights that sum to more than 1
    are normalised. Results do not depend on the number of threads.

    Args:
        means: (N, 2) px positions of the samples (pixel centres). Values are not read. Their
            gradient is that of moving a patch's colours along the image, by differences of
            neighbours on the same patch.
        colours: (N, C).
        crossings: (V, 2, H, W), see ``outline_crossings``.
    """
    return blend_patches_op(
        means.contiguous(), colours.contiguous(), crossings.contiguous(), places.rows, places.ids
    )
