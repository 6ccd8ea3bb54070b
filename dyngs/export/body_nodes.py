"""Bodies that turn as animated nodes of a ``.glb``; all other Gaussians stand as they are at one
time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from dyngs.core.errors import DyngsError
from dyngs.deform.bodies.field import BodyField, bodies_of
from dyngs.deform.scene import field_scene_of
from dyngs.export.splat_files import AS_THEY_ARE, Writing, splats_at
from dyngs.io.formats.formats import Written
from dyngs.io.formats.gltf import EXTENSION, add_gaussians
from dyngs.io.formats.similarity import Similarity
from dyngs.io.formats.splat_file import (
    header_comments,
    offset_notes,
    require_writable,
    unit_rotations,
    with_degree,
)
from dyngs.io.gltf import GlbDocument
from dyngs.io.write import atomic_file
from dyngs.ops.quaternions import shorter_ways, unit_quats
from dyngs.runs.inputs import inputs_of
from dyngs.runs.opened import Opened

SUFFIX = ".glb"


@torch.no_grad()
def write_bodies(opened: Opened, path: Path, time: float, how: Writing = AS_THEY_ARE) -> Written:
    """Write a run at a time in [0, 1] as .glb: a node for each body, with its motion as an
    animation, one for the rest.

    Without the animation the file shows the scene at ``time``. Raises DyngsError: no body turns in
    this run, or the file cannot be written.
    """
    inputs_of(opened).require_output(path)
    scene = field_scene_of(opened.scene)
    field = None if scene is None else bodies_of(scene.field)
    if scene is None or field is None:
        raise DyngsError(
            "--bodies: no body that turns was found in this run; leave it out, or give --times A:B:N"
        )
    scene = scene.unmasked()  # the rows of the labels
    splat = splats_at(opened, scene, time, how)
    require_writable(path, splat.gaussians)
    gaussians = splat.gaussians.replace(quats=unit_rotations(splat.gaussians.quats))
    gaussians = with_degree(gaussians, min(gaussians.sh_degree, 3))
    labels = torch.full((len(scene),), -1, device=scene.moving.device)
    labels[scene.moving] = field.rest.labels
    # Twice as many poses as training times: rotations are interpolated between them.
    moments = np.linspace(0.0, 1.0, 2 * max(len(scene.times) - 1, 1) + 1)
    here_places, here_turns = _poses(field, [time], splat.frame)
    there_places, there_turns = _poses(field, moments, splat.frame)
    document = GlbDocument()
    nodes = []
    meshes = []
    channels = []
    for body in range(-1, len(field.rest.centers)):
        own = gaussians.picked(torch.nonzero(labels == body)[:, 0])
        if not len(own):
            continue
        name = "rest" if body < 0 else f"body {body}"
        node: dict[str, object] = {"name": name, "mesh": len(meshes)}
        if body >= 0:
            place = here_places[0, body]
            own = own.replace(means=(own.means.double() - torch.from_numpy(place)).float())
            node["translation"] = place.tolist()
            turn_back = Rotation.from_quat(here_turns[0, body]).inv()
            turns = Rotation.from_quat(there_turns[:, body]) * turn_back
            channels.append((len(nodes), "translation", there_places[:, body]))
            channels.append((len(nodes), "rotation", shorter_ways(turns.as_quat())))
        meshes.append({"name": name, "primitives": [add_gaussians(document, own)]})
        nodes.append(node)
    document.add_animation("motion", moments * opened.seconds, channels)
    document.json["asset"]["extras"] = header_comments(splat)
    document.json |= {
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
    }
    with atomic_file(path) as temporary:
        document.write(temporary)
    notes = (
        f"bodies: {len(channels) // 2}, which turn for {opened.seconds:.1f} s in the colours of time {time:g}",
        f"all else and shadows stand as at time {time:g}; a sequence has their motion",
        *offset_notes(splat, "the file states it"),
    )
    return Written(path, splat, notes)


def _poses(
    field: BodyField, times: Sequence[float] | np.ndarray, frame: Similarity
) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (T, B, 3) of B bodies at T times, in the axes of the file, and their rotations
    (T, B, 4) xyzw."""
    axes = Rotation.from_quat(np.asarray(frame.turn)[[1, 2, 3, 0]])
    places, quats = zip(*(field.poses(float(time)) for time in times), strict=True)
    unit = unit_quats(torch.stack(quats)).double().numpy()[..., [1, 2, 3, 0]]
    turned = (axes * Rotation.from_quat(unit.reshape(-1, 4))).as_quat()
    return frame.points(torch.stack(places).double().numpy()), turned.reshape(unit.shape)
