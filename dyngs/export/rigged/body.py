"""The body template in the shape of a trained person, as a mesh with one texture coordinate per vertex.

Local letters: M vertices, T triangles and U texture coordinates of the template; V vertices of the mesh, J joints, N
Gaussians, B shape parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.errors import DyngsError
from dyngs.human.avatar.anchors import Anchors
from dyngs.human.avatar.posing import Skeleton
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.template.body import BodyTemplate, apply_shape

_MOST_ROWS = 4000  # anchors whose places determine the shape; each gives three equations


@dataclass(frozen=True)
class BodyMesh:
    """A skinned mesh at rest; m, y up, facing +z."""

    vertices: Tensor  # (V, 3)
    normals: Tensor  # (V, 3) outward unit normals
    uv: Tensor  # (V, 2) texture coordinates, row of the image = (1 - v) * H
    faces: Tensor  # (T, 3) int64, counter-clockwise from outside
    source: Tensor  # (V,) int64 vertex of the template that each is a copy of; more than one where the atlas has a seam
    weights: Tensor  # (V, J) skinning weights, rows sum to 1
    skeleton: Skeleton  # of the person


def body_mesh(scene: HumanScene, body: BodyTemplate, vertices: Tensor) -> BodyMesh:
    """Return the mesh of a person: the template's triangles over ``vertices`` (M, 3) at rest, the person's joints.

    Raises DyngsError: the template has no texture coordinates.
    """
    if body.uv is None or body.uv_faces is None:
        raise DyngsError(
            f"the body template '{body.name}' has no texture coordinates; train with model.uv=FILE.obj for a mesh"
        )
    pairs = body.faces.flatten() * len(body.uv) + body.uv_faces.flatten()
    corners, inverse = torch.unique(pairs, return_inverse=True)
    source = corners // len(body.uv)
    return BodyMesh(
        vertices=vertices[source],
        normals=vertex_normals(vertices, body.faces)[source],
        uv=body.uv[corners % len(body.uv)],
        faces=inverse.reshape(-1, 3),
        source=source,
        weights=body.weights[source],
        skeleton=scene.learned_skeleton,
    )


def rest_vertices(scene: HumanScene, body: BodyTemplate) -> Tensor:
    """Return the template's vertices (M, 3) at rest in the shape of a trained person.

    Runs hold no shape parameters, but joints and points of the surface, which are linear in these: they follow by least
    squares, exactly. Raises DyngsError: the template is not the one that the person was trained on.
    """
    anchors, joints = scene.anchors, scene.skeleton.joints
    if joints.shape != body.joints.shape or int(anchors.face.max()) >= len(body.faces):
        raise DyngsError(f"the template '{body.name}' is not the one that this person was trained on")
    if body.shape_dirs is None or body.joint_shape_dirs is None:
        return body.vertices
    rows = torch.nonzero(anchors.height == 0)[:, 0]  # on the skin
    rows = rows[:: max(len(rows) // _MOST_ROWS, 1)]
    around = body.faces[anchors.face[rows]]
    corners = anchors.barycentric[rows].double()
    mean = (corners[..., None] * body.vertices[around].double()).sum(1)
    directions = torch.einsum("nk,nkdb->ndb", corners, body.shape_dirs[around].double())
    left = torch.cat([directions.flatten(0, 1), body.joint_shape_dirs.double().flatten(0, 1)])
    offsets = (anchors.points[rows].double() - mean, (joints - body.joints).double())
    right = torch.cat([x.flatten() for x in offsets])
    betas = torch.linalg.lstsq(left, right[:, None], driver="gelsd").solution[:, 0]
    return apply_shape(body, betas.to(body.vertices))[0]


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Return outward unit normals (M, 3) at vertices, of the triangles around each, weighted by area."""
    a, b, c = vertices[faces].unbind(1)
    flat = torch.linalg.cross(b - a, c - a, dim=-1)
    total = torch.zeros_like(vertices)
    for k in range(3):
        total.index_add_(0, faces[:, k], flat)
    return torch.nn.functional.normalize(total, dim=-1)


def anchor_normals(anchors: Anchors, body: BodyTemplate, vertices: Tensor) -> Tensor:
    """Return unit normals (N, 3) of the surface ``vertices`` (M, 3) below the Gaussians at rest."""
    around = vertex_normals(vertices, body.faces)[body.faces[anchors.face]]
    return torch.nn.functional.normalize((anchors.barycentric[..., None] * around).sum(1), dim=-1)
