"""A trained person as ``.glb``: the template's mesh, skinned and textured, for programs that know
no Gaussians."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dyngs.core.errors import DyngsError
from dyngs.export.rigged.skeleton import (
    BodyMesh,
    JointAnimation,
    Rig,
    add_animation,
    add_skeleton,
    add_weights,
    anchor_normals,
    animation_of,
    body_mesh,
    rest_vertices,
    rig_of,
)
from dyngs.export.rigged.surface import fitted_surface
from dyngs.export.rigged.texture import bake_texels, fill_unseen, texture_image
from dyngs.human.avatar.scene import HumanScene, avatar_of
from dyngs.human.body.atlas import atlas_texels
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import load_template
from dyngs.human.keys import HumanModel
from dyngs.io.gltf import INDICES, VERTICES, GlbDocument
from dyngs.io.write import atomic_file
from dyngs.runs.checkpoint import LoadedRun
from dyngs.runs.inputs import inputs_of

SUFFIX = ".glb"
_FINER = 4  # texels of the texture per texel of the model's atlas, along a side
_LARGEST = 2048  # texels along a side of the largest texture
_MOST_SAMPLES = 512  # texels along a side of the atlas from which the surface is moved


@dataclass(frozen=True)
class Played:
    """The motion that a file shows: its name and frame rate; the run plays it."""

    name: str
    fps: float


@dataclass(frozen=True)
class MeshFile:
    """A mesh that was written."""

    path: Path  # of the file
    notes: tuple[str, ...]  # a line about each thing that was chosen, or that glTF cannot hold


def write_mesh(run: LoadedRun, path: Path, played: Played | None = None) -> MeshFile:
    """Write the person of a run or avatar file as a skinned mesh with a texture, in T-pose, y up,
    facing +z.

    The size is that of the capture; the soles stand at y = 0. Colours have the light of the capture
    in them, hence a material without light. ``played`` becomes an animation. Raises DyngsError: not
    the run of a person, or its template is missing or without texture coordinates.
    """
    scene, body = person_and_template(run, "--format mesh")
    if path.suffix.lower() != SUFFIX:
        raise DyngsError(
            f"{path}: a mesh is written as {SUFFIX}; give --out {path.with_suffix(SUFFIX).name}"
        )
    inputs_of(run).require_output(path)
    with torch.no_grad():
        vertices = rest_vertices(scene, body)
        normals = anchor_normals(scene.anchors, body, vertices)
        size = texture_size(scene)
        texels = atlas_texels(body, size, vertices)
        filled = fill_unseen(bake_texels(scene, texels, normals), texels)
        image = texture_image(filled.rgb, texels)
        samples = atlas_texels(body, min(size // 2, _MOST_SAMPLES), vertices)
        surface = fitted_surface(
            scene.gaussians, body, vertices, samples, bake_texels(scene, samples, normals)
        )
        mesh = body_mesh(scene, body, surface.vertices)
        rig = rig_of(scene, surface.vertices)
        animation = None
        if played is not None:
            animation = animation_of(
                scene, rig, surface.vertices, body.weights, played.fps, played.name
            )
    document = mesh_document(mesh, rig, image, animation)
    with atomic_file(path) as temporary:
        document.write(temporary)
    fraction = (filled.mirrored + filled.spread) / max(len(texels), 1)
    notes = [
        f"texture of {len(image)} x {len(image)}; {100 * fraction:.1f} % of the body is not seen in the Gaussians and "
        f"has colours from around it, {100 * filled.mirrored / max(len(texels), 1):.1f} % from its mirror side"
    ]
    if surface.margin is None:
        notes.append(
            f"the surface is that of the template, whose silhouettes agree best ({surface.plain:.3f})"
        )
    else:
        notes.append(
            f"the surface is moved to the Gaussians: silhouettes agree at {surface.agreement:.3f} (intersection over "
            f"union), those of the template at {surface.plain:.3f}"
        )
    if scene.shapes is not None:
        notes.append("offsets that depend on the pose are left out: glTF's skins have none")
    notes += scene.left_out
    return MeshFile(path, tuple(notes))


def person_and_template(run: LoadedRun, wanted: str) -> tuple[HumanScene, BodyTemplate]:
    """Return the person of a run and its template.

    Raises DyngsError: the run is not that of a person, or the template cannot be read.
    """
    scene = avatar_of(run.scene)
    model = run.config.model
    if scene is None or not isinstance(model, HumanModel):
        raise DyngsError(
            f"{wanted} needs the run of a person (model.kind=human), this one is {run.config.model.kind}"
        )
    return scene, load_template(model)


def texture_size(scene: HumanScene) -> int:
    """Return the texels along a side of the texture, by the distance of most anchors in the
    atlas."""
    columns, counts = scene.anchors.uv[:, 0].unique(return_counts=True)
    columns = columns[2 * counts >= counts.double().quantile(0.75)]  # without those of finer texels
    finest = float(columns.diff().min()) if len(columns) > 1 else 1.0
    return min(_FINER * max(round(1 / finest), 1), _LARGEST)


def mesh_document(
    mesh: BodyMesh, rig: Rig, image: np.ndarray, animation: JointAnimation | None
) -> GlbDocument:
    """Return a mesh with its skeleton, texture and animation as a glTF document."""
    from PIL import Image

    document = GlbDocument()
    nodes = list[dict[str, Any]]()
    armature, first = add_skeleton(document, rig, nodes)
    nodes.append({"name": "person", "mesh": 0, "skin": 0})
    uv = torch.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], dim=1)
    attributes = {
        "POSITION": document.add_numbers(
            rig.placed(mesh.vertices).float().numpy(), VERTICES, limits=True
        ),
        "NORMAL": document.add_numbers(mesh.normals.float().numpy(), VERTICES),
        "TEXCOORD_0": document.add_numbers(uv.float().numpy(), VERTICES),
    } | add_weights(document, mesh.weights)
    kind = np.uint16 if len(mesh.vertices) < 2**16 - 1 else np.uint32
    indices = document.add_numbers(mesh.faces.flatten().numpy().astype(kind), INDICES)
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "PNG")
    view = document.add_bytes(stream.getvalue())
    texture = {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": 1}
    document.json |= {
        "scene": 0,
        "scenes": [{"nodes": [armature, len(nodes) - 1]}],
        "nodes": nodes,
        "meshes": [
            {
                "name": "person",
                "primitives": [{"attributes": attributes, "indices": indices, "material": 0}],
            }
        ],
        "materials": [
            {
                "name": "person",
                "pbrMetallicRoughness": texture,
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "textures": [{"source": 0, "sampler": 0}],
        "images": [{"name": "albedo", "bufferView": view, "mimeType": "image/png"}],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "extensionsUsed": ["KHR_materials_unlit"],
    }
    if animation is not None:
        add_animation(document, animation, first)
    return document
