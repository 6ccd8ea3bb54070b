"""Export of people as skinned, textured meshes.

Local letters: M vertices and T triangles of the template, V vertices of the mesh, J joints, N
Gaussians, F frames, K joints per Gaussian.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.export.rigged.surface import fit_surface
from dyngs.export.rigged.texture import (
    SEEN,
    bake_texels,
    fill_unseen,
    texture_image,
)
from dyngs.human.avatar.posing import Anchors, Skeleton, heaviest_joints
from dyngs.human.avatar.scene import HumanScene, as_human_scene
from dyngs.human.body.atlas import atlas_texels
from dyngs.human.body.body import BodyTemplate, apply_shape
from dyngs.human.body.body_reader import load_template
from dyngs.human.body.joints import JOINT_NAMES, SMPLX_ROWS
from dyngs.human.body.mesh import vertex_normals
from dyngs.human.body.skinning import (
    apply_transforms,
    blend_transforms,
    joint_transforms,
)
from dyngs.human.keys import HumanModel
from dyngs.human.motion.placement import rotate_clip_to_y_up
from dyngs.io.gltf import INDICES, VERTICES, GlbDocument
from dyngs.io.write import atomic_file
from dyngs.models.kind import HasBody, capability
from dyngs.ops.quaternions import align_quat_signs
from dyngs.runs.checkpoint import LoadedRun
from dyngs.runs.folder import collect_inputs

_MOST_ROWS = 4000  # Most anchors used to fit the shape; each gives three equations


def body_mesh(body: BodyTemplate) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mesh of a template with vertices duplicated at UV seams.

    Returns:
        UV coordinates (V, 2), triangles (T, 3), and template vertices (V,) of the mesh vertices.

    Raises:
        DyngsError: the template has no UV coordinates.
    """
    if body.uv is None or body.uv_faces is None:
        raise DyngsError(
            f"body template '{body.name}' has no UV coordinates; train with model.uv=FILE.obj"
        )
    pairs = body.faces.flatten() * len(body.uv) + body.uv_faces.flatten()
    corners, inverse = torch.unique(pairs, return_inverse=True)
    count = len(body.uv)
    return body.uv[corners % count], inverse.reshape(-1, 3), corners // count


def rest_vertices(scene: HumanScene, body: BodyTemplate) -> Tensor:
    """Return the template vertices (M, 3) in rest pose, in the shape of a trained person.

    Runs store joints and surface points, which are linear in the shape parameters. These are
    recovered by least squares.

    Raises:
        DyngsError: not the template that the person was trained on.
    """
    anchors = scene.anchors
    joints = scene.skeleton.joints
    if joints.shape != body.joints.shape or int(anchors.face.max()) >= len(body.faces):
        raise DyngsError(f"body template '{body.name}' is not the one this person was trained on")
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


def surface_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Return area-weighted outward unit normals (M, 3) at vertices."""
    return torch.from_numpy(vertex_normals(vertices.numpy(), faces.numpy())).float()


def anchor_normals(anchors: Anchors, body: BodyTemplate, vertices: Tensor) -> Tensor:
    """Return unit normals (N, 3) of the surface with ``vertices`` (M, 3) at the anchors of the
    Gaussians."""
    around = surface_normals(vertices, body.faces)[body.faces[anchors.face]]
    return torch.nn.functional.normalize((anchors.barycentric[..., None] * around).sum(1), dim=-1)


_FLOOR_FRAMES = 64  # Most frames in which the lowest vertex is searched
_STILL = 1e-6  # Smaller rotations and scale changes are not animated


@dataclass(frozen=True)
class Rig:
    """A skeleton in rest pose in the axes of the file: y up, facing +z, soles at y = 0."""

    skeleton: Skeleton  # in m
    scale: float  # world units of the capture per metre of the template
    rise: float  # offset of y after scaling

    @property
    def joints(self) -> Tensor:
        """Joints (J, 3) in the axes of the file."""
        return self.to_file_axes(self.skeleton.joints)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints: those of SMPL-X, with hands for the last two of SMPL."""
        count = len(self.skeleton.joints)
        known = [JOINT_NAMES[row] for row in SMPLX_ROWS[count]]
        return (*known, *("left_hand", "right_hand")[: count - len(known)])

    def to_file_axes(self, points: Tensor) -> Tensor:
        """Transform points (..., 3) in rest pose, in m, to the axes of the file."""
        moved = self.scale * points
        moved[..., 1] += self.rise
        return moved


def build_rig(scene: HumanScene, vertices: Tensor) -> Rig:
    """Return the rig of a person with rest-pose surface ``vertices`` (V, 3) in m."""
    scale = float(scene.clip.scale.mean()) * float(np.exp(scene.fit.log_scale))
    return Rig(scene.learned_skeleton, scale, -scale * float(vertices[:, 1].amin()))


@dataclass(frozen=True)
class AnimationInfo:
    """Name and frame rate of the exported motion, which the run plays."""

    name: str
    fps: float


def add_animation(
    document: GlbDocument,
    scene: HumanScene,
    rig: Rig,
    vertices: Tensor,
    weights: Tensor,
    played: AnimationInfo,
) -> None:
    """Add the motion of a person as an animation of the joints, which are the first nodes.

    It is y up, on the floor y = 0, around the origin. Joints without rotation have no channel.

    Args:
        vertices: (V, 3) in rest pose, in m, used to find the floor.
        weights: (V, J) skinning weights.
    """
    joints = rig.skeleton.joints
    parents = rig.skeleton.parents
    clip = rotate_clip_to_y_up(scene.played_clip, scene.clip, joints)
    frames = torch.linspace(0, len(clip) - 1, min(len(clip), _FLOOR_FRAMES), device="cpu").long()
    posed = joint_transforms(joints, parents, clip.rotations[frames])
    heights = apply_transforms(blend_transforms(weights, posed), vertices)[..., 1].amin(1)
    floor = float((clip.scale[frames] * heights + clip.trans[frames, 1]).amin())
    root = (clip.scale[:, None] * joints[0] + clip.trans).double().numpy()
    middle = root.mean(axis=0)
    root = root - np.array([middle[0], floor, middle[2]])
    poses = clip.poses.double().numpy()
    quats = Rotation.from_rotvec(poses.reshape(-1, 3)).as_quat().reshape(*poses.shape[:2], 4)
    quats = align_quat_signs(quats)
    scale = clip.scale.double().numpy() / rig.scale
    channels = [(0, "translation", root)]
    if np.abs(scale - 1).max() > _STILL:
        channels.append((0, "scale", np.repeat(scale[:, None], 3, axis=1)))
    for joint in range(quats.shape[1]):
        if np.abs(quats[:, joint, :3]).max() > _STILL:
            channels.append((joint, "rotation", quats[:, joint]))
    document.add_animation(played.name, np.arange(len(root)) / played.fps, channels)


def add_person(document: GlbDocument, rig: Rig, primitive: dict[str, Any]) -> None:
    """Add a mesh of one ``primitive``, a skin, and joint nodes below a node called Armature.

    The joints are the first nodes.
    """
    joints = rig.joints.double()
    parents = rig.skeleton.parents
    nodes: list[dict[str, Any]] = []
    for i, (name, parent) in enumerate(zip(rig.names, parents, strict=True)):
        place = joints[i] - joints[parent] if parent >= 0 else joints[i]
        children = [child for child, above in enumerate(parents) if above == i]
        node: dict[str, Any] = {"name": name, "translation": place.tolist()}
        nodes.append(node | {"children": children} if children else node)
    roots = [i for i, parent in enumerate(parents) if parent < 0]
    nodes.append({"name": "Armature", "children": roots})
    nodes.append({"name": "person", "mesh": 0, "skin": 0})
    bind = np.tile(np.eye(4, dtype=np.float32), (len(joints), 1, 1))
    bind[:, 3, :3] = -joints.numpy()  # column-major
    skin = {
        "joints": list(range(len(joints))),
        "inverseBindMatrices": document.add_numbers(bind.reshape(-1, 16)),
        "skeleton": roots[0],
    }
    document.json |= {
        "skins": [skin],
        "scene": 0,
        "scenes": [{"nodes": [len(joints), len(joints) + 1]}],
        "nodes": nodes,
        "meshes": [{"name": "person", "primitives": [primitive]}],
    }


def add_weights(document: GlbDocument, weights: Tensor) -> dict[str, int]:
    """Add joints and weights (V, J) of vertices, heaviest first. Return the accessors by
    attribute."""
    joints, fractions = heaviest_joints(weights)
    missing = -fractions.shape[1] % 4
    joints, fractions = (torch.nn.functional.pad(x, (0, missing)) for x in (joints, fractions))
    joints = torch.where(fractions > 0, joints, 0).to(torch.uint8)
    found: dict[str, int] = {}
    for k, (own, shares) in enumerate(zip(joints.split(4, 1), fractions.split(4, 1), strict=True)):
        if k and not bool(shares.any()):
            break
        found[f"JOINTS_{k}"] = document.add_numbers(own.numpy(), VERTICES)
        found[f"WEIGHTS_{k}"] = document.add_numbers(shares.float().numpy(), VERTICES)
    return found


_FINER = 4  # Texels of the texture per texel of the UV map of the model, along a side
_LARGEST = 2048  # Largest side of the texture in texels
_MOST_SAMPLES = 512  # Largest side in texels of the UV map from which the surface is displaced


def write_mesh(run: LoadedRun, path: Path, played: AnimationInfo | None = None) -> tuple[str, ...]:
    """Write the person of a run or avatar file as a skinned, textured mesh in T-pose, y up, facing
    +z.

    The size is that of the capture, with soles at y = 0. The material is unlit, since colours
    contain the lighting of the capture. ``played`` is added as an animation.

    Returns:
        notes about choices, and about properties that glTF cannot store.

    Raises:
        DyngsError: not the run of a person, or a missing template or UV map.
    """
    scene, body = person_and_template(run)
    collect_inputs(run).require_output(path)
    with torch.no_grad():
        vertices = rest_vertices(scene, body)
        normals = anchor_normals(scene.anchors, body, vertices)
        size = texture_size(scene)
        texels = atlas_texels(body, size, vertices)
        baked = bake_texels(scene, texels, normals)
        image = texture_image(fill_unseen(baked, texels), texels)
        samples = atlas_texels(body, min(size // 2, _MOST_SAMPLES), vertices)
        surface = fit_surface(
            scene.gaussians, body, vertices, samples, bake_texels(scene, samples, normals)
        )
        rig = build_rig(scene, surface.vertices)
        document = mesh_document(body, rig, surface.vertices, image)
        if played is not None:
            add_animation(document, scene, rig, surface.vertices, body.weights, played)
    with atomic_file(path) as temporary:
        document.write(temporary)
    moved = "of the template" if surface.margin is None else "fitted to the Gaussians"
    unseen = 100 * float((baked.alpha < SEEN).float().mean())
    notes = [
        f"texture {len(image)} x {len(image)}; {unseen:.1f} % of the body is unseen and filled "
        "from its "
        "surroundings or its mirror side",
        f"surface {moved}: silhouette IoU {surface.agreement:.3f} (template: {surface.plain:.3f})",
    ]
    if scene.shapes is not None:
        notes.append("pose-dependent offsets are not exported: glTF skins have none")
    return (*notes, *scene.left_out)


def person_and_template(run: LoadedRun) -> tuple[HumanScene, BodyTemplate]:
    """Return the person of a run and its body template.

    Raises:
        DyngsError: not the run of a person, or an unreadable template.
    """
    scene = as_human_scene(run.scene)
    model = run.config.model
    if scene is None or capability(model, HasBody) is None:
        raise DyngsError(
            f"--format mesh needs a run of a person (model.kind=human), not {model.kind}"
        )
    return scene, load_template(cast(HumanModel, model))


def texture_size(scene: HumanScene) -> int:
    """Return the side of the texture in texels, from the spacing of most anchors in the UV map."""
    columns, counts = scene.anchors.uv[:, 0].unique(return_counts=True)
    columns = columns[
        2 * counts >= counts.double().quantile(0.75)
    ]  # without columns of finer texels
    finest = float(columns.diff().min()) if len(columns) > 1 else 1.0
    return min(_FINER * max(round(1 / finest), 1), _LARGEST)


def mesh_document(body: BodyTemplate, rig: Rig, vertices: Tensor, image: np.ndarray) -> GlbDocument:
    """Return a glTF document of a mesh with rest-pose ``vertices`` (M, 3), skeleton and texture."""
    from PIL import Image

    document = GlbDocument()
    uv, faces, source = body_mesh(body)
    normals = surface_normals(vertices, body.faces)[source]
    uv = torch.stack([uv[:, 0], 1 - uv[:, 1]], dim=1)
    places = rig.to_file_axes(vertices[source]).float().numpy()
    kind = np.uint16 if len(source) < 2**16 - 1 else np.uint32
    primitive = {
        "attributes": {
            "POSITION": document.add_numbers(places, VERTICES, limits=True),
            "NORMAL": document.add_numbers(normals.float().numpy(), VERTICES),
            "TEXCOORD_0": document.add_numbers(uv.float().numpy(), VERTICES),
        }
        | add_weights(document, body.weights[source]),
        "indices": document.add_numbers(faces.flatten().numpy().astype(kind), INDICES),
        "material": 0,
    }
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "PNG")
    view = document.add_bytes(stream.getvalue())
    unlit = "KHR_materials_unlit"
    texture = {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": 1}
    material = {"name": "person", "pbrMetallicRoughness": texture, "extensions": {unlit: {}}}
    document.json |= {
        "extensionsUsed": [unlit],
        "materials": [material],
        "textures": [{"source": 0, "sampler": 0}],
        "images": [{"name": "albedo", "bufferView": view, "mimeType": "image/png"}],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
    }
    add_person(document, rig, primitive)
    return document
