"""A radiance field or curved triangles as a mesh that other programs read: .ply, .glb, .obj, colours of vertices."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dyngs.errors import DyngsError
from dyngs.fields import mesh as fields
from dyngs.fields.scene import FieldScene
from dyngs.files.write import atomic_file
from dyngs.models.surface import Surface
from dyngs.runs.inputs import inputs_of
from dyngs.runs.opened import Opened
from dyngs.triangles import mesh as triangles
from dyngs.triangles.scene import TriangleScene

SUFFIXES = ".ply", ".glb", ".obj"


def write_surface(
    opened: Opened, out: Path, *, time: float = 0.0, level: float | None = None, segments: int | None = None
) -> Surface:
    """Write the surface of a field at ``time``, or curved triangles, in the capture's own coordinates, and return it.

    Args:
        level: density at the surface of a field; None: as usual.
        segments: of an edge of a curved triangle; None: as usual.

    Raises:
        DyngsError: it is neither, a suffix of no mesh, an option of the other, or no surface is there.
    """
    scene = opened.renderable
    if not isinstance(scene, (FieldScene, TriangleScene)):
        raise DyngsError(f"{out}: a surface is that of a radiance field or curved triangles (ngp, nerf, bg_triangle)")
    if level is not None and not isinstance(scene, FieldScene):
        raise DyngsError("--level goes with --format mesh of a radiance field (model.kind=ngp or nerf)")
    if segments is not None and not isinstance(scene, TriangleScene):
        raise DyngsError("--segments goes with --format mesh of curved triangles (model.kind=bg_triangle)")
    if out.suffix.lower() not in SUFFIXES:
        raise DyngsError(f"{out}: a mesh of a surface is one file that ends in {', '.join(SUFFIXES)}")
    inputs_of(opened).require_output(out)
    import trimesh

    if isinstance(scene, FieldScene):
        surface = fields.surface_of(scene, time, level)
    else:
        surface = triangles.surface_of(scene, segments)
    vertices = surface.vertices + np.asarray(opened.world_offset, dtype=np.float64)
    colours = np.round(255 * surface.colours.clip(0, 1)).astype(np.uint8)
    mesh = trimesh.Trimesh(vertices, surface.faces, vertex_colors=colours, process=False)
    with atomic_file(out) as temporary:
        data: Any = mesh.export(file_type=out.suffix.lower()[1:])
        temporary.write_bytes(data.encode("utf-8") if isinstance(data, str) else data)
    return surface
