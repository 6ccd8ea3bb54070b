"""The body of a trained person as a mesh, and its skeleton in glTF: nodes, a skin, a motion as an
animation.

Local letters: M vertices and T triangles of the template, V vertices of the mesh, J joints, N
Gaussians, F frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.human.avatar.posing import Anchors, Skeleton, heaviest_joints
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.body import BodyTemplate, apply_shape
from dyngs.human.body.joints import JOINT_NAMES, SMPLX_ROWS
from dyngs.human.body.skinning import (
    apply_transforms,
    axis_angle_to_matrix,
    blend_transforms,
    joint_transforms,
)
from dyngs.human.motion.placement import upright
from dyngs.io.gltf import VERTICES, GlbDocument
from dyngs.ops.quaternions import shorter_ways

_MOST_ROWS = 4000  # anchors whose places determine the shape; each gives three equations


@dataclass(frozen=True)
class BodyMesh:
    """A skinned mesh at rest; m, y up, facing +z."""

    vertices: Tensor  # (V, 3)
    normals: Tensor  # (V, 3) outward unit normals
    uv: Tensor  # (V, 2) texture coordinates, row of the image = (1 - v) * H
    faces: Tensor  # (T, 3) int64, counter-clockwise from outside
    # (V,) int64 vertex of the template that each is a copy of; more than one where the atlas has a
    # seam
    source: Tensor
    weights: Tensor  # (V, J) skinning weights, rows sum to 1
    skeleton: Skeleton  # of the person


def body_mesh(scene: HumanScene, body: BodyTemplate, vertices: Tensor) -> BodyMesh:
    """Return the mesh of a person: the template's triangles over ``vertices`` (M, 3) at rest, the
    person's joints.

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

    Runs hold no shape parameters, but joints and points of the surface, which are linear in these:
    they follow by least squares, exactly. Raises DyngsError: the template is not the one that the
    person was trained on.
    """
    anchors = scene.anchors
    joints = scene.skeleton.joints
    if joints.shape != body.joints.shape or int(anchors.face.max()) >= len(body.faces):
        raise DyngsError(
            f"the template '{body.name}' is not the one that this person was trained on"
        )
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
    """Return outward unit normals (M, 3) at vertices, of the triangles around each, weighted by
    area."""
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


_FLOOR_FRAMES = 64  # frames, evenly spread, in which the lowest vertex is looked for
_STILL = 1e-6


@dataclass(frozen=True)
class Rig:
    """A skeleton at rest in the axes of the file: y up, facing +z, soles at y = 0."""

    skeleton: Skeleton  # in m, as the person was trained
    scale: float  # world units of the capture per metre of the template
    rise: float  # what is added to y after scaling

    @property
    def joints(self) -> Tensor:
        """Joints (J, 3) in the file."""
        return self.placed(self.skeleton.joints)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints: those of SMPL-X, and hands for SMPL's last two."""
        count = len(self.skeleton.joints)
        known = [JOINT_NAMES[row] for row in SMPLX_ROWS[count]]
        return (*known, *("left_hand", "right_hand")[: count - len(known)])

    def placed(self, points: Tensor) -> Tensor:
        """Return points (..., 3) at rest, m, in the file."""
        moved = self.scale * points
        moved[..., 1] += self.rise
        return moved


@dataclass(frozen=True)
class JointAnimation:
    """Motion of a rig's joints."""

    name: str  # of the animation
    seconds: np.ndarray  # (F,) float64
    quats: np.ndarray  # (F, J, 4) xyzw, relative to the parent joints
    root: np.ndarray  # (F, 3) place of the root joint
    root_scale: np.ndarray  # (F,) its scale; 1 for a person who keeps the size


def rig_of(scene: HumanScene, vertices: Tensor) -> Rig:
    """Return the rig of a person whose surface at rest has ``vertices`` (V, 3), m."""
    scale = float(scene.clip.scale.mean()) * float(np.exp(scene.fit.log_scale))
    return Rig(scene.learned_skeleton, scale, -scale * float(vertices[:, 1].amin()))


def animation_of(
    scene: HumanScene, rig: Rig, vertices: Tensor, weights: Tensor, fps: float, name: str
) -> JointAnimation:
    """Return the motion that a person plays: y up, on the floor y = 0, around the origin.

    ``vertices``: (V, 3) at rest, m, of which the lowest one stands on the floor. ``weights``: (V,
    J).
    """
    joints = rig.skeleton.joints
    parents = rig.skeleton.parents
    clip = upright(scene.moves_as, scene.clip, joints)
    frames = torch.linspace(0, len(clip) - 1, min(len(clip), _FLOOR_FRAMES), device="cpu").long()
    lowest = []
    for row in frames.tolist():
        posed = joint_transforms(joints, parents, axis_angle_to_matrix(clip.poses[row]))
        heights = apply_transforms(blend_transforms(weights, posed), vertices)[:, 1].amin()
        lowest.append(float(clip.scale[row] * heights + clip.trans[row, 1]))
    root = (clip.scale[:, None] * joints[0] + clip.trans).double().numpy()
    middle = root.mean(axis=0)
    root = root - np.array([middle[0], min(lowest), middle[2]])
    poses = clip.poses.double().numpy()
    quats = Rotation.from_rotvec(poses.reshape(-1, 3)).as_quat().reshape(*poses.shape[:2], 4)
    seconds = np.arange(len(root)) / fps
    return JointAnimation(
        name, seconds, shorter_ways(quats), root, clip.scale.double().numpy() / rig.scale
    )


def add_skeleton(document: GlbDocument, rig: Rig, nodes: list[dict[str, Any]]) -> tuple[int, int]:
    """Add the nodes of the joints below one called Armature, and a skin; return the nodes Armature
    and first joint."""
    joints = rig.joints.double()
    parents = rig.skeleton.parents
    first = len(nodes)
    for i, (name, parent) in enumerate(zip(rig.names, parents, strict=True)):
        place = joints[i] - joints[parent] if parent >= 0 else joints[i]
        node: dict[str, Any] = {"name": name, "translation": place.tolist()}
        children = [first + child for child, above in enumerate(parents) if above == i]
        nodes.append(node | {"children": children} if children else node)
    roots = [first + i for i, parent in enumerate(parents) if parent < 0]
    nodes.append({"name": "Armature", "children": roots})
    bind = np.tile(np.eye(4, dtype=np.float32), (len(joints), 1, 1))
    bind[:, 3, :3] = -joints.numpy()  # columns first
    matrices = document.add_numbers(bind.reshape(-1, 16))
    skin = {
        "joints": list(range(first, first + len(joints))),
        "inverseBindMatrices": matrices,
        "skeleton": roots[0],
    }
    document.json["skins"] = [skin]
    return len(nodes) - 1, first


def add_animation(document: GlbDocument, animation: JointAnimation, first: int) -> None:
    """Add an animation of the joints, whose nodes begin at ``first``; joints that never turn have
    no channel."""
    channels = [(first, "translation", animation.root)]
    if np.abs(animation.root_scale - 1).max() > _STILL:
        channels.append((first, "scale", np.repeat(animation.root_scale[:, None], 3, axis=1)))
    for joint in range(animation.quats.shape[1]):
        if np.abs(animation.quats[:, joint, :3]).max() > _STILL:
            channels.append((first + joint, "rotation", animation.quats[:, joint]))
    document.add_animation(animation.name, animation.seconds, channels)


def add_weights(document: GlbDocument, weights: Tensor) -> dict[str, int]:
    """Add the joints and weights (V, J) of vertices; return the accessors by attribute, the
    heaviest four first."""
    joints, fractions = heaviest_joints(weights)
    filled = -(-fractions.shape[1] // 4) * 4 - fractions.shape[1]
    joints, fractions = (torch.nn.functional.pad(x, (0, filled)) for x in (joints, fractions))
    joints = torch.where(fractions > 0, joints, 0).to(torch.uint8)
    found: dict[str, int] = {}
    for k in range(0, fractions.shape[1], 4):
        own = fractions[:, k : k + 4]
        if k and not bool(own.any()):
            break
        found[f"JOINTS_{k // 4}"] = document.add_numbers(joints[:, k : k + 4].numpy(), VERTICES)
        found[f"WEIGHTS_{k // 4}"] = document.add_numbers(own.float().numpy(), VERTICES)
    return found
