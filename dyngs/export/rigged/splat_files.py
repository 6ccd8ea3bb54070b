"""A person's Gaussians at rest with joints and weights: ``.ply`` with further columns, ``.glb``
with a skin.

Local letters: N Gaussians, J joints, K joints that one Gaussian follows.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from dyngs.core.conventions import SH_C0
from dyngs.core.errors import DyngsError
from dyngs.export.rigged.mesh_file import Played, person_and_template
from dyngs.export.rigged.skeleton import (
    Rig,
    add_animation,
    add_skeleton,
    add_weights,
    anchor_normals,
    animation_of,
    rest_vertices,
    rig_of,
)
from dyngs.export.rigged.texture import frontal_colours
from dyngs.gaussians import Gaussians
from dyngs.human.avatar.posing import heaviest_joints
from dyngs.human.avatar.scene import HumanScene
from dyngs.io.formats.gltf import EXTENSION, add_gaussians
from dyngs.io.formats.ply import write_ply
from dyngs.io.formats.splat_file import SplatFile, require_writable
from dyngs.io.gltf import GlbDocument
from dyngs.io.write import atomic_file
from dyngs.runs.checkpoint import LoadedRun
from dyngs.runs.inputs import inputs_of

SUFFIXES = (".ply", ".glb")


@dataclass(frozen=True)
class RiggedSplats:
    """Files of Gaussians with joints that were written: where, and a line about each thing that
    they cannot hold."""

    path: Path
    notes: tuple[str, ...]


@torch.no_grad()
def write_rigged_splats(run: LoadedRun, path: Path, played: Played | None = None) -> RiggedSplats:
    """Write the person of a run or avatar file at rest, with skinning weights: T-pose, y up, facing
    +z, soles at y = 0.

    ``.ply``: columns ``joint_0`` to ``joint_7`` (heaviest first) and ``weight_0`` to ``weight_7``
    after those of 3DGS, and a comment ``joint INDEX NAME PARENT X Y Z`` for each joint. ``.glb``:
    KHR_gaussian_splatting with a skin, and ``played`` as an animation. Raises DyngsError: not the
    run of a person, or its template is missing.
    """
    scene, body = person_and_template(run, "--joints")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise DyngsError(
            f"{path}: joints are written as {' or '.join(SUFFIXES)}; give --out with one of these"
        )
    if suffix == ".ply" and played is not None:
        raise DyngsError(
            "--motion does not go with --joints in a .ply, which shows the rest pose; write a .glb"
        )
    inputs_of(run).require_output(path)
    vertices = rest_vertices(scene, body)
    rig = rig_of(scene, vertices)
    gaussians = scene.gaussians
    notes = ()
    if scene.colour is not None:
        colours = frontal_colours(scene, anchor_normals(scene.anchors, body, vertices))
        gaussians = gaussians.replace(sh=((colours - 0.5) / SH_C0)[:, None])
        notes = (
            "the colours of the run are a network; the file has those seen from straight above the skin",
        )
    if scene.shapes is not None:
        notes = (*notes, "offsets that depend on the pose are left out: skinning weights hold none")
    notes = (*notes, *scene.left_out)
    gaussians = gaussians.replace(
        means=rig.placed(gaussians.means),
        log_scales=gaussians.log_scales + float(np.log(rig.scale)),
    )
    require_writable(path, gaussians)
    if suffix == ".ply":
        _write_columns(path, run, scene, rig, gaussians)
        return RiggedSplats(path, notes)
    document = _document(scene, rig, gaussians)
    if played is not None:
        animation = animation_of(scene, rig, vertices, body.weights, played.fps, played.name)
        add_animation(document, animation, 0)
    with atomic_file(path) as temporary:
        document.write(temporary)
    unsure = "KHR_gaussian_splatting does not say whether skins turn Gaussians: viewers may show the rest pose"
    return RiggedSplats(path, (*notes, unsure))


def _write_columns(
    path: Path, run: LoadedRun, scene: HumanScene, rig: Rig, gaussians: Gaussians
) -> None:
    joints, weights = heaviest_joints(scene.weights)
    columns = {f"joint_{k}": joints[:, k].numpy() for k in range(joints.shape[1])}
    columns |= {f"weight_{k}": weights[:, k].numpy() for k in range(weights.shape[1])}
    places = [" ".join(f"{x:.6f}" for x in place) for place in rig.joints.tolist()]
    lines = [
        f"joint {i} {name} {parent} {place}"
        for i, (name, parent, place) in enumerate(
            zip(rig.names, rig.skeleton.parents, places, strict=True)
        )
    ]
    model = run.config.model
    splat = SplatFile(gaussians, model.rasterize_mode, model.eps2d, comments=tuple(lines), up="y")
    with atomic_file(path) as temporary:
        write_ply(temporary, splat, columns)


def _document(scene: HumanScene, rig: Rig, gaussians: Gaussians) -> GlbDocument:
    """Return Gaussians with a skin as a glTF document; the joints are the first nodes."""
    document = GlbDocument()
    nodes: list[dict[str, object]] = []
    armature, _ = add_skeleton(document, rig, nodes)
    nodes.append({"name": "person", "mesh": 0, "skin": 0})
    primitive = add_gaussians(document, gaussians)
    primitive["attributes"] |= add_weights(document, scene.weights)
    document.json |= {
        "scene": 0,
        "scenes": [{"nodes": [armature, len(nodes) - 1]}],
        "nodes": nodes,
        "meshes": [{"name": "person", "primitives": [primitive]}],
        "extensionsUsed": [EXTENSION],
    }
    return document
