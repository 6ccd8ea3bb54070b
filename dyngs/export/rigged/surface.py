"""Body template surface displaced to the Gaussians, to include clothes, hair and shoes.

Local letters: M vertices, T triangles, P surface samples, N Gaussians.
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
from dyngs.export.orbits import cameras_on_circle, pinhole_camera
from dyngs.export.rigged.texture import SEEN, BakedTexels
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.human.avatar.observations import project_points
from dyngs.human.body.atlas import Texels
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.mesh import rasterize

# Tried distances in m from the uppermost Gaussian centres to the surface
MARGINS = (0.0, 0.004, 0.008, 0.012, 0.016)
_BOUNDS = (-0.02, 0.06)  # Smallest and largest displacement, m
_SMOOTH = 0.01  # Standard deviation in m of the weights that average displacements
_NEAR = 64  # Samples averaged per vertex
# Heights in m above a sample at which the body itself excludes the sample (mouth, eye sockets)
_FOLDS = (0.01, 0.02, 0.03)
_SIZE = 256  # Side of silhouette images in pixels
# View directions of silhouettes around the body
_ANGLES = (0.0, math.pi / 4, math.pi / 2, 3 * math.pi / 4)


@dataclass(frozen=True)
class FittedSurface:
    """Displaced rest-pose vertices, and the agreement of silhouettes with those of the
    Gaussians."""

    vertices: Tensor  # (M, 3) in m
    # chosen distance of ``MARGINS``, or None for the undisplaced template
    margin: float | None
    agreement: float  # intersection over union of silhouettes
    plain: float  # the same for the undisplaced template


def fit_surface(
    gaussians: Gaussians, body: BodyTemplate, vertices: Tensor, samples: Texels, baked: BakedTexels
) -> FittedSurface:
    """Return the surface whose silhouettes agree best with those of the Gaussians.

    The template and surfaces displaced by several margins are compared. A vertex is displaced by
    the mean displacement of nearby samples along their normals.

    Args:
        vertices: (M, 3) in rest pose, in the shape of the person.
    """
    cameras = _cameras(vertices)
    shown = render(gaussians, cameras, RenderOptions()).alpha.numpy() > 0.5
    plain = _agreement(vertices, body, cameras, shown)
    best = FittedSurface(vertices, None, plain, plain)
    counts = _on_largest_part(body)[samples.faces] & (baked.alpha >= SEEN)
    rows = torch.nonzero(counts & ~_faces_body(body, vertices, samples))[:, 0]
    if not len(rows):
        return best
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
        if agreement > best.agreement:
            best = FittedSurface(moved, margin, agreement, plain)
    return best


def _on_largest_part(body: BodyTemplate) -> Tensor:
    """Return (T,) bool, triangles of the largest connected part, without eyes and tongue."""
    count = len(body.vertices)
    ends = body.faces.repeat(1, 2)[:, [0, 1, 1, 2]].reshape(-1, 2).numpy()
    edges = coo_array((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(count, count))
    part = torch.from_numpy(connected_components(edges, directed=False)[1]).long()[body.faces[:, 0]]
    return part == part.bincount().argmax()


def _faces_body(body: BodyTemplate, vertices: Tensor, samples: Texels) -> Tensor:
    """Return (P,) bool, samples that face the body itself at a small distance."""
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
    """Return upright cameras around the body, at the height of its middle."""
    lowest = vertices.amin(0).double().numpy()
    highest = vertices.amax(0).double().numpy()
    middle = (lowest + highest) / 2
    distance = 3 * float(np.linalg.norm(highest - lowest))
    camera = pinhole_camera(0.47 * 6 * _SIZE, _SIZE, _SIZE)
    _, up, forward = np.eye(3)
    return cameras_on_circle(camera, middle, up, forward, np.array(_ANGLES), distance, 0.0)


def _agreement(vertices: Tensor, body: BodyTemplate, cameras: Cameras, shown: np.ndarray) -> float:
    """Return the intersection over union of mesh silhouettes with silhouettes ``shown`` (V, H,
    W)."""
    common = either = 0
    for camera, mask in zip(cameras, shown, strict=True):
        pixels = project_points(vertices, camera)[0] - 0.5
        flat = torch.nn.functional.pad(pixels, (0, 1), value=1.0)
        seen = rasterize(flat[body.faces].double().numpy(), cameras.width, cameras.height)
        own = np.zeros(mask.size, bool)
        own[seen.index] = True
        common += int((own & mask.ravel()).sum())
        either += int((own | mask.ravel()).sum())
    return common / max(either, 1)
