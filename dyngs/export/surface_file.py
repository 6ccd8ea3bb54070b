"""Export of the surface of a scene as a mesh (.ply, .glb, .obj) with vertex colours."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dyngs.baselines.fields.kind import NgpModel
from dyngs.baselines.fields.scene import space_of
from dyngs.core.errors import DyngsError
from dyngs.data.times import evenly_spaced
from dyngs.export.splat_files import WriteOptions, choose_write_options
from dyngs.gaussians.surface import extract_surface, opaque_box
from dyngs.io.formats.ply import encode_ply
from dyngs.io.formats.similarity import Similarity, origin_offset
from dyngs.io.write import atomic_file
from dyngs.models.renderable import Surface, SurfaceOptions
from dyngs.models.views import training_cameras
from dyngs.runs.folder import collect_inputs
from dyngs.runs.opened import OpenedScene

SUFFIXES = ".ply", ".glb", ".obj"


def surface_write_options(
    opened: OpenedScene, suffix: str, up: str | None, from_up: str | None
) -> tuple[WriteOptions, str]:
    """Return the rotation of an exported mesh, and a note about it, see ``choose_write_options``.

    Viewers expect y up in .glb and .obj. A .ply keeps the axes of the capture.
    """
    usual = "keep" if suffix.lower() == ".ply" else None
    return choose_write_options(opened, "y", up or usual, from_up)


def write_surface(
    opened: OpenedScene,
    out: Path,
    *,
    time: float,
    options: SurfaceOptions,
    how: WriteOptions,
) -> Surface:
    """Write the surface of a scene at ``time`` and return it, in the coordinates of the capture.

    Raises:
        DyngsError: unsupported suffix or option, a missing capture, or an empty surface.
    """
    suffix = out.suffix.lower()
    scene = opened.renderable
    for name, value in vars(options).items():
        if value is not None and name not in scene.surface_options:
            raise DyngsError(f"--{name}: not supported for the mesh of this scene; remove it")
    if suffix not in SUFFIXES:
        raise DyngsError(f"{out}: a mesh file must end in {', '.join(SUFFIXES)}")
    collect_inputs(opened).require_output(out)
    surface = scene.own_surface(time, options) or _fused_surface(opened, time, options.cells)
    vertices = Similarity(how.turn).points(opened.world.points(surface.vertices))
    colours = np.round(255 * surface.colours.clip(0, 1)).astype(np.uint8)
    with atomic_file(out) as temporary:
        temporary.write_bytes(_mesh_bytes(suffix, vertices, surface.faces, colours))
    return surface


def _mesh_bytes(suffix: str, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray) -> bytes:
    """Return the content of a mesh file. Vertices (V, 3) far from the origin are stored with more
    digits."""
    import trimesh

    detail = float(np.median(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1)))
    offset = origin_offset(vertices, detail)
    if suffix == ".ply" and offset.any():
        return encode_ply(vertices, colours[:, :3], faces)
    mesh: Any = trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)
    if suffix == ".obj":
        decimals = 8 if detail == 0 else max(8, 3 - math.floor(math.log10(detail)))
        return mesh.export(file_type="obj", digits=decimals).encode("utf-8")
    if suffix == ".ply":
        return mesh.export(file_type="ply")
    mesh.vertices = vertices - offset
    scene: Any = trimesh.Scene()
    scene.add_geometry(mesh, transform=trimesh.transformations.translation_matrix(offset))
    return scene.export(file_type="glb")


def _fused_surface(opened: OpenedScene, time: float, cells: int | None) -> Surface:
    """Return the surface of Gaussians fused from training views, bounded to the captured volume."""
    scene = opened.scene
    views = opened.capture.splits["train"]
    seen = [views[i] for i in evenly_spaced(len(views), 150)]
    cameras = training_cameras(seen, opened.config.data)
    box = opaque_box(scene.at(time))
    if not opened.capture.has_alpha:
        space = space_of(NgpModel(), None, opened.capture)
        middle = torch.tensor(space.centre, device="cpu")
        cube = middle - space.half, middle + space.half
        common = torch.maximum(box[0], cube[0]), torch.minimum(box[1], cube[1])
        shares_much = bool((common[1] - common[0] > 0.1 * space.half).all())
        box = common if shares_much else cube
    return extract_surface(scene, cameras, box, time, cells=cells)
