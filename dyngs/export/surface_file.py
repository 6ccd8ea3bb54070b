"""A scene's surface as a mesh that other programs read: .ply, .glb or .obj with colours of
vertices."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dyngs.baselines.fields.kind import NgpModel
from dyngs.baselines.fields.scene import FieldScene, space_of
from dyngs.baselines.fields.scene import surface_of as surface_of_field
from dyngs.baselines.triangles import mesh as triangles
from dyngs.baselines.triangles.scene import TriangleScene
from dyngs.core.errors import DyngsError
from dyngs.data.times import evenly_spaced
from dyngs.export.splat_files import AS_THEY_ARE, Writing, writing_of
from dyngs.gaussians import surface as gaussians
from dyngs.gaussians.scene import GaussianScene
from dyngs.io.formats.ply import double_ply
from dyngs.io.formats.similarity import Similarity, far_offset
from dyngs.io.write import atomic_file
from dyngs.models.renderable import Surface
from dyngs.models.views import training_cameras
from dyngs.ops.patches import MOST_SEGMENTS
from dyngs.runs.folder import inputs_of
from dyngs.runs.opened import Opened

SUFFIXES = ".ply", ".glb", ".obj"
VIEWS = 150  # Of the training views, whose depths are averaged for a surface of Gaussians
MOST_CELLS = 1024


@dataclass(frozen=True)
class Cut:
    """How a surface is cut out of a scene; None: as usual.

    Attributes:
        level: density at the surface of a field, per unit of a world whose innermost cube has half
            side 1.5.
        cells: along the longest side of the space that a field or Gaussians are looked at in.
        segments: of an edge of a curved triangle.
    """

    level: float | None = None
    cells: int | None = None
    segments: int | None = None

    def require_fitting(self, scene: object) -> None:
        """Check that all that is given goes with the kind of scene. Raises DyngsError."""
        is_field = isinstance(scene, FieldScene)
        is_triangles = isinstance(scene, TriangleScene)
        given = {
            "level": (is_field, "a radiance field (model.kind=ngp or nerf)", None),
            "segments": (
                is_triangles,
                "curved triangles (model.kind=bg_triangle)",
                (1, MOST_SEGMENTS),
            ),
            "cells": (not is_triangles, "radiance fields and Gaussians", (8, MOST_CELLS)),
        }
        for name, (fits, kinds, limits) in given.items():
            value = getattr(self, name)
            if value is not None and not fits:
                raise DyngsError(f"--{name} goes with --format mesh of {kinds}")
            if value is not None and limits and not limits[0] <= value <= limits[1]:
                raise DyngsError(f"--{name} {value}: give {limits[0]} to {limits[1]}")


def upright_surface(
    opened: Opened, suffix: str, up: str | None, from_up: str | None
) -> tuple[Writing, str]:
    """Return how the mesh of a scene is turned, and a line about it, as of ``writing_of``.

    Viewers take y for up in .glb and .obj; those of .ply have no convention, so it stays in the
    axes of the capture.
    """
    usual = "keep" if suffix.lower() == ".ply" else None
    return writing_of(opened, "y", up or usual, from_up)


def write_surface(
    opened: Opened,
    out: Path,
    *,
    time: float = 0.0,
    cut: Cut | None = None,
    how: Writing = AS_THEY_ARE,
) -> Surface:
    """Write the surface of a scene at ``time`` and return it.

    The file is in the coordinates of the capture or of the edit, turned by ``how``. Raises
    DyngsError: a person, a suffix of no mesh, an option of another kind, no capture where that is
    needed, or no surface is there.
    """
    cut = cut or Cut()
    suffix = out.suffix.lower()
    cut.require_fitting(opened.renderable)
    if suffix not in SUFFIXES:
        raise DyngsError(
            f"{out}: a mesh of a surface is one file that ends in {', '.join(SUFFIXES)}"
        )
    inputs_of(opened).require_output(out)
    surface = _surface(opened, time, cut)
    vertices = Similarity(how.turn).points(opened.world.points(surface.vertices))
    colours = np.round(255 * surface.colours.clip(0, 1)).astype(np.uint8)
    with atomic_file(out) as temporary:
        temporary.write_bytes(_mesh_bytes(suffix, vertices, surface.faces, colours))
    return surface


def _mesh_bytes(suffix: str, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray) -> bytes:
    """Return the file of a mesh; vertices (V, 3) too far from the origin for float32 are written
    with more digits."""
    import trimesh

    detail = float(np.median(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1)))
    offset = far_offset(vertices, detail)
    if suffix == ".ply" and offset.any():
        return double_ply(vertices, colours[:, :3], faces)
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


def _surface(opened: Opened, time: float, cut: Cut) -> Surface:
    match opened.renderable:
        case FieldScene() as scene:
            return surface_of_field(scene, time, cut.level, cut.cells)
        case TriangleScene() as scene:
            return triangles.surface_of(scene, cut.segments)
        case GaussianScene() as scene if opened.person is None:
            return _surface_of_gaussians(opened, scene, time, cut)
        case _:
            raise DyngsError(
                "a surface is that of a still or moving scene; a person's mesh is its body"
            )


def _surface_of_gaussians(opened: Opened, scene: GaussianScene, time: float, cut: Cut) -> Surface:
    """Return what training cameras see of Gaussians; what they frame, where there is a
    background."""
    views = opened.capture.splits["train"]
    seen = [views[i] for i in evenly_spaced(len(views), VIEWS)]
    cameras = training_cameras(seen, opened.config.data)
    box = gaussians.opaque_box(scene.at(time))
    if not opened.capture.has_alpha:
        space = space_of(NgpModel(), None, opened.capture)
        middle = torch.tensor(space.centre, device="cpu")
        cube = middle - space.half, middle + space.half
        common = torch.maximum(box[0], cube[0]), torch.minimum(box[1], cube[1])
        shares_much = bool((common[1] - common[0] > 0.1 * space.half).all())
        box = common if shares_much else cube
    return gaussians.surface_of(scene, cameras, box, time, cells=cut.cells)
