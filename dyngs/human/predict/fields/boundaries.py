"""Boundaries of a body as a camera sees them: its mesh, and dilated and eroded copies, by a
z-buffer.

The surface of a dressed person lies between both copies, so that rays are looked at nowhere else
(EG-HumanNeRF).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.human.body.mesh import Fragments, rasterize, vertex_normals
from dyngs.human.predict.fields.people import Body

OUTWARDS, INWARDS = 0.06, 0.04  # How far the copies are from the mesh, m
_NEAREST = 0.05  # Least depth of what is drawn, m


@dataclass(frozen=True)
class Interval:
    """Where the rays of H x W pixels may meet a person, as depths in m; infinite where they do
    not."""

    begin: Tensor  # (H, W) where they come in
    end: Tensor  # (H, W) where they are surely inside, or come out
    body: Tensor  # (H, W) where they meet the body itself


class Boundaries:
    """The meshes of a body."""

    def __init__(self, body: Body) -> None:
        self._body = body

    @cached_property
    def _meshes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Triangles (T, 3), and vertices (M, 3) of the body, of the dilated and of the eroded
        copy."""
        vertices, faces = (x.cpu().numpy() for x in (self._body.vertices, self._body.faces))
        vertices = vertices.astype(np.float64)
        normals = vertex_normals(vertices, faces)
        return faces, vertices, vertices + OUTWARDS * normals, vertices - INWARDS * normals

    @cached_property
    def _tree(self) -> tuple[KDTree, np.ndarray]:
        """Return the vertices of the body (M, 3) to be searched, and their normals (M, 3)."""
        faces, vertices, _, _ = self._meshes
        return KDTree(vertices), vertex_normals(vertices, faces)

    def height(self, points: Tensor) -> Tensor:
        """Return how far points (N, 3) are from the nearest vertex of the body, m; negative
        inside."""
        tree, normals = self._tree
        places = points.detach().cpu().double().numpy()
        found, rows = tree.query(places)
        distance = np.asarray(found)
        nearest = np.asarray(rows)
        inside = ((places - tree.data[nearest]) * normals[nearest]).sum(1) < 0
        return torch.from_numpy(np.where(inside, -distance, distance)).to(points)

    def depth(self, camera: Cameras) -> Tensor:
        """Return depths (H, W) of the body, m, infinite beside it."""
        faces, body, _, _ = self._meshes
        return depths(body, faces, camera)

    def interval(self, camera: Cameras) -> Interval:
        """Return where the rays of one camera may meet the person."""
        faces, body, outer, inner = self._meshes
        begin = depths(outer, faces, camera)
        out = depths(outer, faces, camera, last=True)
        # what is thinner than the copy is eroded is turned inside out: its back faces lie before
        # its front, and where there are cavities (mouth, eyes) and between fingers even front faces
        # do; nobody is inside before the body
        surely = depths(inner, faces, camera, front_faces=True)
        met = depths(body, faces, camera)
        end = torch.where(
            met.isfinite(), torch.minimum(torch.maximum(surely, met + INWARDS / 2), out), out
        )
        return Interval(begin, torch.maximum(end, begin), met)


def depths(
    vertices: np.ndarray,
    faces: np.ndarray,
    camera: Cameras,
    *,
    last: bool = False,
    front_faces: bool = False,
) -> Tensor:
    """Return depths (H, W) at pixel centres where rays meet a mesh first, m, or ``last``; infinite
    beside it.

    ``vertices`` (M, 3), ``faces`` (T, 3) anticlockwise from outside. ``front_faces``: of those
    alone.
    """
    pose, k = (x[0].double().cpu().numpy() for x in (camera.cam_from_world, camera.intrinsics))
    local = vertices @ pose[:3, :3].T + pose[:3, 3]
    inverse = 1 / np.maximum(local[:, 2], _NEAREST)
    pixels = (local @ k.T)[:, :2] * inverse[:, None] - 0.5
    most = 1.01 / _NEAREST
    corners = np.concatenate([pixels, (most - inverse if last else inverse)[:, None]], axis=1)[
        faces
    ]
    (x0, x1, x2), (y0, y1, y2) = corners[..., 0].T, corners[..., 1].T
    hidden = (local[faces, 2] <= _NEAREST).any(axis=1)
    if front_faces:
        hidden |= (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0) >= 0  # rows go down
    near_image = (
        (corners[..., 0].max(1) >= 0)
        & (corners[..., 0].min(1) <= camera.width - 1)
        & (corners[..., 1].max(1) >= 0)
        & (corners[..., 1].min(1) <= camera.height - 1)
    )
    corners = corners[near_image & ~hidden]
    found: Fragments = rasterize(corners, camera.width, camera.height)
    # linear in the image
    nearness = 1 / (found.barycentric / corners[found.faces, :, 2]).sum(axis=1)
    image = np.full(camera.height * camera.width, np.inf)
    image[found.index] = 1 / (most - nearness if last else nearness)
    shape = camera.height, camera.width
    return torch.from_numpy(image.reshape(shape)).to(camera.intrinsics)
