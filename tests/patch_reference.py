"""Bezier patches in plain torch, pixel by pixel: what the kernels are tested against."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.ops.patches import Places, lattice

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


def reference_visible(points: Tensor, cameras: Cameras, near: float, segments: int) -> tuple[Tensor, Tensor, Tensor]:
    """(V, H, W) ids, (V, H, W, 2) places and (V, H, W) depth: each ray with each face, by Cramer's rule."""
    places, faces = lattice(segments)
    corners = torch.einsum("kb,pbc->pkc", bernstein(places[:, 0], places[:, 1]), points.double())
    shape = len(cameras), cameras.height, cameras.width
    ids, uv = torch.full(shape, -1, dtype=torch.int32), torch.zeros(*shape, 2, dtype=torch.float64)
    depth = torch.full(shape, math.inf, dtype=torch.float64)
    for view in range(len(cameras)):
        pose, inner = cameras.cam_from_world[view].double(), cameras.intrinsics[view].double()
        seen = corners @ pose[:3, :3].T + pose[:3, 3]
        for y in range(cameras.height):
            for x in range(cameras.width):
                ray = torch.linalg.solve(inner, torch.tensor([x + 0.5, y + 0.5, 1.0], dtype=torch.float64))
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
    means: Tensor, colours: Tensor, places: Places, sigma: float, radius: float
) -> tuple[Tensor, Tensor]:
    """As ``blend_patches``, by its definition."""
    window, search = min(4, math.ceil(2.5 * sigma)), math.ceil(radius) + 1
    images, through = [], []
    for rows in places.rows.tolist():
        height, width = len(rows), len(rows[0])
        pixels = [(x, y) for y in range(height) for x in range(width)]
        label = {(x, y): -1 if rows[y][x] < 0 else int(places.ids[rows[y][x]]) for x, y in pixels}

        def around(x: int, y: int, half: int, label: dict[tuple[int, int], int] = label) -> list[tuple[int, int]]:
            found = [(x + i, y + j) for j in range(-half, half + 1) for i in range(-half, half + 1)]
            return [q for q in found if q in label]

        def mean(q: tuple[int, int], rows: list[list[int]] = rows) -> Tensor:
            row = rows[q[1]][q[0]]
            return means.new_tensor([q[0] + 0.5, q[1] + 0.5]) if row < 0 else means[row]

        outline = {q for q in pixels if any(label[n] != label[q] for n in around(*q, 1))}
        for x, y in pixels:
            centre = means.new_tensor([x + 0.5, y + 0.5])

            def counts(patch: int, x: int = x, y: int = y, centre: Tensor = centre) -> Tensor:
                inside = label[(x, y)] == patch
                near = [q for q in around(x, y, search) if q in outline and label[q] == patch]
                distances = [(mean(q) - centre).square().sum().sqrt() for q in near]
                least = min(range(len(near)), key=lambda i: float(distances[i].detach()), default=-1)
                if least < 0 or distances[least] >= radius:
                    return centre.new_tensor(float(inside))
                distance = distances[least].detach() if distances[least] < 0.1 else distances[least]
                half = 0.5 * 2 ** (distance / radius)
                return half if inside else 1 - half

            weights, sums, behind = [], torch.zeros(colours.shape[1], dtype=colours.dtype), means.new_zeros(())
            for q in around(x, y, window):
                value = (-0.5 * (mean(q) - centre).square().sum() / sigma**2).exp()
                weights.append(value * counts(label[q]))
                row = rows[q[1]][q[0]]
                if row < 0:
                    behind = behind + weights[-1]
                else:
                    sums = sums + weights[-1] * colours[row]
            total = torch.stack(weights).sum()
            images.append(sums / total)
            through.append(behind / total)
    shape = places.rows.shape
    return torch.stack(images).view(*shape, -1), torch.stack(through).view(shape)
