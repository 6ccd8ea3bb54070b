"""The template's surface moved to where the Gaussians are: clothes, hair, shoes.

Local letters: M vertices, T triangles, P samples of the surface, N Gaussians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.data.geometry import cameras_at_poses, look_at
from dyngs.export.rigged.texture import SEEN, BakedTexels
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.human.body.atlas import Texels
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.mesh import rasterize

MARGINS = (0.0, 0.004, 0.008, 0.012, 0.016)
"""Distances, m, from the uppermost Gaussians to the surface that are tried: Gaussians reach beyond
their centres."""
_BOUNDS = (-0.02, 0.06)  # least and greatest displacement, m
_SMOOTH = 0.01  # standard deviation, m, of the weights by which displacements are averaged
_NEAR = 64  # samples that displace a vertex
_FOLDS = (0.01, 0.02, 0.03)
"""Distances, m, above a sample at which the body must not be for the sample to count: mouth, eye
sockets."""
_SIZE = 256
_ANGLES = (0.0, math.pi / 4, math.pi / 2, 3 * math.pi / 4)
"""Silhouettes that are compared: pixels along a side, and directions around the body."""


@dataclass(frozen=True)
class FittedSurface:
    """Vertices (M, 3) at rest, m, and how well silhouettes agree with those of the Gaussians."""

    vertices: Tensor  # (M, 3)
    # the distance of ``MARGINS`` that was taken; None: the template as it is agrees better
    margin: float | None
    agreement: float  # intersection over union of the silhouettes
    plain: float  # the same for the template as it is


def fit_surface(
    gaussians: Gaussians, body: BodyTemplate, vertices: Tensor, samples: Texels, baked: BakedTexels
) -> FittedSurface:
    """Return the surface whose silhouettes agree best with the Gaussians', of the template's and
    some moved ones.

    A vertex is displaced by the mean displacement of the samples around it in space, along their
    normals, up to what is seen there. ``vertices`` (M, 3) are at rest in the person's shape.
    """
    cameras = _cameras(vertices)
    shown = render(gaussians, cameras, RenderOptions()).alpha.numpy() > 0.5
    plain = _agreement(vertices, body, cameras, shown)
    found = FittedSurface(vertices, None, plain, plain)
    counts = _on_largest_part(body)[samples.faces] & (baked.alpha >= SEEN)
    rows = torch.nonzero(counts & ~_folded(body, vertices, samples))[:, 0]
    if not len(rows):
        return found
    count = min(_NEAR, len(rows))
    distance, at = (
        torch.from_numpy(x.reshape(len(vertices), count))
        for x in KDTree(samples.points[rows].numpy()).query(vertices.numpy(), k=count)
    )
    near = rows[at]
    weights = (-0.5 * (distance / _SMOOTH) ** 2).exp().float()
    weights = weights * (samples.size.square() * baked.alpha)[near]
    total = weights.sum(1, keepdim=True)
    for margin in MARGINS:
        height = (baked.top + margin).clamp(*_BOUNDS)
        along = (weights[..., None] * (height[:, None] * samples.normals)[near]).sum(1)
        moved = vertices + torch.where(total > 1e-12, along / total.clamp_min(1e-12), 0.0)
        agreement = _agreement(moved, body, cameras, shown)
        if agreement > found.agreement:
            found = FittedSurface(moved, margin, agreement, plain)
    return found


def _on_largest_part(body: BodyTemplate) -> Tensor:
    """Return whether each of T triangles belongs to the largest connected part: eyes and tongue do
    not."""
    count = len(body.vertices)
    ends = body.faces.repeat(1, 2)[:, [0, 1, 1, 2]].reshape(-1, 2).numpy()
    edges = coo_array((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(count, count))
    part = torch.from_numpy(connected_components(edges, directed=False)[1]).long()[body.faces[:, 0]]
    return part == part.bincount().argmax()


def _folded(body: BodyTemplate, vertices: Tensor, samples: Texels) -> Tensor:
    """Return whether each of P samples faces the body itself at a small distance."""
    corners = vertices[body.faces]
    a, b, c = corners.unbind(1)
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a, dim=-1), dim=-1)
    places = KDTree(corners.mean(1).numpy())
    found = torch.zeros(len(samples), dtype=torch.bool, device="cpu")
    for height in _FOLDS:
        above = (samples.points + height * samples.normals).numpy()
        distance, at = places.query(above, k=min(4, places.n))
        near = torch.from_numpy(at.reshape(len(samples), -1))
        is_close = torch.from_numpy(distance.reshape(len(samples), -1) < 0.7 * height)
        is_opposite = (normals[near] * samples.normals[:, None]).sum(-1) < -0.2
        found |= (is_close & is_opposite).any(1)
    return found


def _cameras(vertices: Tensor) -> Cameras:
    """Return cameras around the body, upright, at eye level of its middle."""
    lowest = vertices.amin(0).double().numpy()
    highest = vertices.amax(0).double().numpy()
    middle = (lowest + highest) / 2
    reach = float(np.linalg.norm(highest - lowest)) / 2
    distance = 6 * reach
    focal = 0.47 * _SIZE * distance / reach
    matrix = [[focal, 0, _SIZE / 2], [0, focal, _SIZE / 2], [0, 0, 1.0]]
    first = Cameras(
        torch.eye(4, device="cpu")[None], torch.tensor([matrix], device="cpu"), _SIZE, _SIZE
    )
    ways = [np.array([math.sin(angle), 0.0, math.cos(angle)]) for angle in _ANGLES]
    up = np.array([0.0, 1.0, 0.0])
    return cameras_at_poses(
        first, np.stack([look_at(middle + distance * w, middle, up) for w in ways])
    )


def _agreement(vertices: Tensor, body: BodyTemplate, cameras: Cameras, shown: np.ndarray) -> float:
    """Return intersection over union of silhouettes of the mesh with those ``shown`` (V, H, W) from
    all cameras."""
    common = either = 0
    for pose, intrinsics, mask in zip(
        cameras.cam_from_world, cameras.intrinsics, shown, strict=True
    ):
        pixels = (vertices @ pose[:3, :3].T + pose[:3, 3]) @ intrinsics.T
        flat = torch.nn.functional.pad(pixels[:, :2] / pixels[:, 2:] - 0.5, (0, 1), value=1.0)
        seen = rasterize(flat[body.faces].double().numpy(), cameras.width, cameras.height)
        own = np.zeros(mask.size, bool)
        own[seen.index] = True
        common += int((own & mask.ravel()).sum())
        either += int((own | mask.ravel()).sum())
    return common / max(either, 1)
