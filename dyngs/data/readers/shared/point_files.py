"""Files of points beside a transforms file: named in it, or found by name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.data.capture import PointCloud
from dyngs.data.readers.shared.transforms import FrameFile
from dyngs.errors import DyngsError, reading
from dyngs.files.containment import inside

USUAL_NAMES = ("points3d.ply", "points3D.ply", "fused.ply", "points.ply")
"""Names that 4DGaussians, COLMAP and nerfstudio give to first points, in the order in which they are looked for."""
KEY = "ply_file_path"


@dataclass(frozen=True)
class FoundPoints:
    """Points beside a transforms file: the file that they are from, and warnings; None where there are none."""

    points: PointCloud | None = None
    path: Path | None = None
    warnings: tuple[str, ...] = ()


def find_points(file: FrameFile) -> FoundPoints:
    """Return the points that belong to a transforms file.

    Those of its key ``ply_file_path``; else of the first of ``USUAL_NAMES`` that is in its folder; else of the only
    ``.ply`` there. A file that is named nowhere and cannot be read is left out, with a warning.

    Raises:
        DyngsError: the file that the key names is missing, unreadable, or outside the capture.
    """
    root, written = file.path.parent, file.fields.get(KEY)
    if isinstance(written, str) and written:
        path = inside(root / written)
        return FoundPoints(read_points(path), path)
    usual = [root / name for name in USUAL_NAMES if (root / name).is_file()]
    path = usual[0] if usual else _only_ply(root)
    if path is None:
        return FoundPoints()
    try:
        points = read_points(inside(path))
    except DyngsError as error:
        return FoundPoints(warnings=(f"not used as points: {error}",))
    return FoundPoints(points, path) if len(points.xyz) else FoundPoints()


def _only_ply(root: Path) -> Path | None:
    """Return the only file of the folder that ends in .ply, None where there are none or several."""
    found = [path for path in root.iterdir() if path.suffix.lower() == ".ply" and path.is_file()]
    return found[0] if len(found) == 1 else None


def read_points(path: Path) -> PointCloud:
    """Read the points of a ``.ply`` file (through trimesh), grey where it has no colours.

    Raises:
        DyngsError: missing or unreadable.
    """
    import trimesh

    if not path.is_file():
        raise DyngsError(f"{path}: no such point file; restore it or remove {KEY}")
    # From an open file: given a path, trimesh would look for textures beside it.
    with reading(path, "it must be a .ply file of points; export it again"), path.open("rb") as file:
        loaded: Any = trimesh.load(file, file_type="ply", process=False, skip_materials=True)
        xyz = np.asarray(loaded.vertices, dtype=np.float64).reshape(-1, 3)
        own = isinstance(loaded, trimesh.PointCloud)
        colours = loaded.colors if own else getattr(loaded.visual, "vertex_colors", None)
        rgb = np.full((len(xyz), 3), 128, np.uint8)
        if colours is not None and len(colours) == len(xyz):
            rgb = np.ascontiguousarray(np.asarray(colours)[:, :3].astype(np.uint8))
    return PointCloud(xyz, rgb)
