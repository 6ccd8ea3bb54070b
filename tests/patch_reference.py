"""Bezier patches in plain torch, pixel by pixel: the reference of the kernels."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.ops.patches import PatchSamples, lattice
from dyngs.ops.rasterization import Boundaries

ORDER = (2, 0, 0), (1, 1, 0), (1, 0, 1), (0, 2, 0), (0, 1, 1), (0, 0, 2)


def bernstein(u: Tensor, v: Tensor) -> Tensor:
    """(..., 6) weights of the control points."""
    w = 1 - u - v
    weights = []
    for i, j, k in ORDER:
        count = 2 / (math.factorial(i) * math.factorial(j) * math.factorial(k))
        weights.append(count * u**i * v**j * w**k)
    return torch.stack(weights, -1)


def reference_values(values: Tensor, ids: Tensor, uv: Tensor) -> Tensor:
    return (bernstein(uv[:, 0], uv[:, 1])[..., None] * values[ids.long()]).sum(1)


def reference_visible(
    points: Tensor, cameras: Cameras, near: float, segments: int
) -> tuple[Tensor, Tensor, Tensor]:
    """(V, H, W) ids, (V, H, W, 2) patch coordinates and depth: each ray with each face, by
    Cramer's rule.
    """
    places, faces = lattice(segments)
    corners = torch.einsum("kb,pbc->pkc", bernstein(places[:, 0], places[:, 1]), points.double())
    shape = len(cameras), cameras.height, cameras.width
    ids = torch.full(shape, -1, dtype=torch.int32)
    uv = torch.zeros(*shape, 2, dtype=torch.float64)
    depth = torch.full(shape, math.inf, dtype=torch.float64)
    for view in range(len(cameras)):
        pose = cameras.cam_from_world[view].double()
        inner = cameras.intrinsics[view].double()
        seen = corners @ pose[:3, :3].T + pose[:3, 3]
        for y in range(cameras.height):
            for x in range(cameras.width):
                ray = torch.linalg.solve(
                    inner, torch.tensor([x + 0.5, y + 0.5, 1.0], dtype=torch.float64)
                )
                for patch in range(len(points)):
                    for face in faces:
                        a = seen[patch][face].T
                        if abs(float(torch.linalg.det(a))) < 1e-12:
                            continue
                        part = torch.linalg.solve(a, ray)
                        if (part < 0).any() or part.sum() <= 0:
                            continue
                        z = float(1 / part.sum())
                        if z >= near and z < depth[view, y, x]:
                            depth[view, y, x], ids[view, y, x] = z, patch
                            uv[view, y, x] = (part / part.sum()) @ places[face]
    return ids, uv, depth


def reference_blend(
    colours: Tensor, crossings: Tensor, places: PatchSamples
) -> tuple[Tensor, Tensor]:
    """Reference of ``blend_patches``; a pixel holds a row of colours and a transmittance."""
    views, height, width = places.rows.shape
    shown = torch.cat([colours, torch.zeros_like(colours[:, :1])], 1)
    nothing = torch.nn.functional.pad(colours.new_zeros(colours.shape[1]), (0, 1), value=1.0)
    pixels: list[Tensor] = []
    for view in range(views):

        def at(x: int, y: int, view: int = view) -> Tensor:
            row = int(places.rows[view, y, x])
            return nothing if row < 0 else shown[row]

        for y in range(height):
            for x in range(width):
                shares: list[tuple[Tensor, Tensor]] = []
                for axis, (dx, dy) in enumerate(((1, 0), (0, 1))):
                    if x + dx < width and y + dy < height:
                        covered = (0.5 - crossings[view, axis, y, x]).clamp_min(0)
                        shares.append((covered, at(x + dx, y + dy)))
                    if x >= dx and y >= dy:
                        covered = (crossings[view, axis, y - dy, x - dx] - 0.5).clamp_min(0)
                        shares.append((covered, at(x - dx, y - dy)))
                total = sum((share for share, _ in shares), colours.new_zeros(()))
                mixed = (1 - total).clamp_min(0) * at(x, y) + sum(
                    (share * c for share, c in shares), nothing * 0
                )
                pixels.append(mixed / total.clamp_min(1))
    image = torch.stack(pixels).view(views, height, width, -1)
    return image[..., :-1], image[..., -1]


NOISE = 0.1  # px; nearer samples get no gradient


def reference_weights(given: Boundaries) -> Tensor:
    """Return the weights (1, N, H, W) of Gaussians at pixels, from all samples of their outlines."""
    height, width = given.rows.shape
    shown = torch.where(given.rows >= 0, given.ids[given.rows.clamp_min(0).long()], -1)
    outline = torch.zeros(len(given.ids), dtype=torch.bool)
    for y in range(height):
        for x in range(width):
            around = shown[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
            if given.rows[y, x] >= 0 and bool((around != shown[y, x]).any()):
                outline[int(given.rows[y, x])] = True
    rows, columns = (torch.arange(n, dtype=given.samples.dtype) + 0.5 for n in (height, width))
    centres = torch.stack(torch.meshgrid(rows, columns, indexing="ij")[::-1], -1)
    weights: dict[int, Tensor] = {}
    for patch in given.ids.unique().tolist():
        inside = shown == patch
        weight = inside.to(centres)
        own = given.samples[outline & (given.ids == patch)]
        if len(own):
            squared = (own[:, None, None] - centres).square().sum(-1)
            nearest = squared.detach().argmin(0, keepdim=True)
            distance = squared.gather(0, nearest)[0].clamp_min(1e-30).sqrt()
            distance = torch.where(distance < NOISE, distance.detach(), distance)
            rho = distance / given.radius
            half = 2 ** (rho - 1)
            weight = torch.where(rho < 1, torch.where(inside, half, 1 - half), weight)
        weights[patch] = weight
    return torch.stack([weights[patch] for patch in given.ids.tolist()])[None]
