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


Pixel = tuple[int, int]


class _View:
    """One view of ``reference_blend``."""

    def __init__(self, means: Tensor, places: Places, rows: list[list[int]], radius: float) -> None:
        self.means, self.rows, self.radius, self.search = means, rows, radius, math.ceil(radius) + 1
        self.pixels = [(x, y) for y in range(len(rows)) for x in range(len(rows[0]))]
        self.label = {(x, y): -1 if rows[y][x] < 0 else int(places.ids[rows[y][x]]) for x, y in self.pixels}
        self.outline = {q for q in self.pixels if any(self.label[n] != self.label[q] for n in self.around(q, 1))}

    def around(self, pixel: Pixel, half: int) -> list[Pixel]:
        steps = range(-half, half + 1)
        return [q for q in [(pixel[0] + i, pixel[1] + j) for j in steps for i in steps] if q in self.label]

    def row(self, pixel: Pixel) -> int:
        return self.rows[pixel[1]][pixel[0]]

    def centre(self, pixel: Pixel) -> Tensor:
        return self.means.new_tensor([pixel[0] + 0.5, pixel[1] + 0.5])

    def mean(self, pixel: Pixel) -> Tensor:
        return self.centre(pixel) if self.row(pixel) < 0 else self.means[self.row(pixel)]

    def counts(self, pixel: Pixel, patch: int) -> Tensor:
        """How much a patch counts at a pixel."""
        inside, centre = self.label[pixel] == patch, self.centre(pixel)
        near = [q for q in self.around(pixel, self.search) if q in self.outline and self.label[q] == patch]
        distances = [(self.mean(q) - centre).square().sum().sqrt() for q in near]
        least = min(range(len(near)), key=lambda i: float(distances[i].detach()), default=-1)
        if least < 0 or distances[least] >= self.radius:
            return centre.new_tensor(float(inside))
        distance = distances[least].detach() if distances[least] < 0.1 else distances[least]
        half = 0.5 * 2 ** (distance / self.radius)
        return half if inside else 1 - half


def reference_blend(
    means: Tensor, colours: Tensor, places: Places, sigma: float, radius: float
) -> tuple[Tensor, Tensor]:
    """As ``blend_patches``, by its definition."""
    window = min(4, math.ceil(2.5 * sigma))
    images: list[Tensor] = []
    through: list[Tensor] = []
    for rows in places.rows.tolist():
        view = _View(means, places, rows, radius)
        for pixel in view.pixels:
            seen, behind, total = colours.new_zeros(colours.shape[1]), means.new_zeros(()), means.new_zeros(())
            for q in view.around(pixel, window):
                value = (-0.5 * (view.mean(q) - view.centre(pixel)).square().sum() / sigma**2).exp()
                weight = value * view.counts(pixel, view.label[q])
                total = total + weight
                if view.row(q) < 0:
                    behind = behind + weight
                else:
                    seen = seen + weight * colours[view.row(q)]
            images.append(seen / total)
            through.append(behind / total)
    shape = places.rows.shape
    return torch.stack(images).view(*shape, -1), torch.stack(through).view(shape)
