"""The surface of a radiance field as a mesh that other programs read: .ply, .glb or .obj with colours of vertices."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dyngs.errors import DyngsError
from dyngs.fields.mesh import Surface, surface_of
from dyngs.fields.scene import FieldScene
from dyngs.files.write import atomic_file
from dyngs.runs.inputs import inputs_of
from dyngs.runs.opened import Opened

SUFFIXES = ".ply", ".glb", ".obj"


def write_surface(opened: Opened, out: Path, *, time: float = 0.0, level: float | None = None) -> Surface:
    """Write the surface of a field at ``time`` in the capture's own coordinates, and return it.

    Raises DyngsError: it is no field, a suffix of no mesh, or no surface is there.
    """
    scene = opened.renderable
    if not isinstance(scene, FieldScene):
        raise DyngsError(f"{out}: a surface is that of a radiance field (model.kind=ngp or nerf)")
    if out.suffix.lower() not in SUFFIXES:
        raise DyngsError(f"{out}: a mesh of a radiance field is one file that ends in {', '.join(SUFFIXES)}")
    inputs_of(opened).require_output(out)
    import trimesh

    surface = surface_of(scene, time, level)
    vertices = surface.vertices + np.asarray(opened.world_offset, dtype=np.float64)
    colours = np.round(255 * surface.colours.clip(0, 1)).astype(np.uint8)
    mesh = trimesh.Trimesh(vertices, surface.faces, vertex_colors=colours, process=False)
    with atomic_file(out) as temporary:
        data: Any = mesh.export(file_type=out.suffix.lower()[1:])
        temporary.write_bytes(data.encode("utf-8") if isinstance(data, str) else data)
    return surface
