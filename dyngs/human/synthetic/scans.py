"""Captures of people from textured scans: THuman2.0, RenderPeople, or any .obj and .glb files."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from scipy.ndimage import map_coordinates

from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.human.body.mesh import Fragments, interpolate
from dyngs.human.synthetic.capture import (
    DirectionalLight,
    Paint,
    PeopleOptions,
    PosedMesh,
    open_people_set,
    person_options,
    ring_cameras,
    write_split,
)
from dyngs.io.outputs import PHOTO_SUFFIXES, atomic_folder

_SUFFIXES = (".glb", ".obj")
_HEIGHT = 1.8  # to which people are scaled, m (Zheng et al. 2024)
_MAX_TEXTURE = 2048  # px per side
_MAX_ASPECT = 2.0  # largest width of a person relative to the height
_LIGHT_IN_TEXTURE = DirectionalLight(ambient=(1.0,), diffuse=(0.0,))


def write_scans(
    folder: Path,
    out: Path,
    options: PeopleOptions,
    report: ProgressCallback = ignore_progress,
) -> int:
    """Render all scans below ``folder`` as captures ``out/scans/NAME`` with depth maps; return
    their number.

    Scans are y up; people are scaled to 1.8 m. Cameras are those of ``write_people``, light is
    that of the textures. Existing captures are kept. Raises DyngsError: no scans, a damaged file,
    no texture, options out of range, or other contents of ``out``.
    """
    # A scan in both formats is read once.
    scans = {
        "_".join(path.relative_to(folder).with_suffix("").parts): path
        for path in sorted(folder.rglob("[!.]*"))
        if path.suffix.lower() in _SUFFIXES
    }
    if not scans:
        raise DyngsError(f"{folder}: contains no .obj or .glb files; give the folder of the scans")
    open_people_set(out, options)
    for number, (name, path) in enumerate(scans.items()):
        person = out / "scans" / name
        if not person.is_dir():
            mesh = read_scan(path)
            # The cameras of a scan do not depend on other scans.
            ring = person_options(options, crc32(name.encode()))
            with atomic_folder(person) as started:
                write_split(
                    started,
                    "train",
                    [mesh],
                    dict(enumerate(ring_cameras(ring))),
                    ring,
                    _LIGHT_IN_TEXTURE,
                )
        report("scans", number + 1, len(scans))
    return len(scans)


def read_scan(path: Path) -> PosedMesh:
    """Read a scan that is y up; return it 1.8 m high, in the middle of the floor y = 0.

    Raises DyngsError: a damaged file, no texture, or not a standing person.
    """
    import trimesh

    with wrap_read_errors(path, "export it as .obj with a texture image, or as .glb"):
        mesh: Any = trimesh.load(path, force="mesh", process=False)
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        low = vertices.min(axis=0)
        width, height, depth = vertices.max(axis=0) - low
        uv = np.asarray(mesh.visual.uv, dtype=np.float64)
        texture = _texture(path, mesh.visual.material)
    if not 0 < max(width, depth) <= _MAX_ASPECT * height:
        raise DyngsError(
            f"{path}: {width:.3g} x {depth:.3g} wide and {height:.3g} high, no person who stands "
            "along y; rotate the scan"
        )
    placed = (vertices - low - 0.5 * np.array([width, 0.0, depth])) * (_HEIGHT / height)
    faces = np.asarray(mesh.faces)
    return PosedMesh(placed, faces, texture_paint(uv, faces, texture))


def texture_paint(uv: np.ndarray, uv_faces: np.ndarray, texture: np.ndarray) -> Paint:
    """Return a paint that samples a texture, bilinear, repeated beyond [0, 1].

    Args:
        uv: (U, 2) coordinates; row of the texture = (1 - v) * height.
        uv_faces: (T, 3) indices into ``uv``.
        texture: (height, width, 3) sRGB values in [0, 1].
    """
    height, width, _ = texture.shape

    def paint(fragments: Fragments) -> np.ndarray:
        u, v = interpolate(fragments.barycentric, uv[uv_faces[fragments.faces]]).T
        places = ((1.0 - v) * height - 0.5, u * width - 0.5)
        channels = [
            map_coordinates(channel, places, order=1, mode="grid-wrap")
            for channel in np.moveaxis(texture, 2, 0)
        ]
        return np.stack(channels, axis=-1)

    return paint


def _texture(path: Path, material: Any) -> np.ndarray:
    """Return the texture (height, width, 3) of a scan's material, else of an image beside it."""
    from PIL import Image

    image = getattr(material, "image", getattr(material, "baseColorTexture", None))
    # trimesh has an image of 2 x 2 px in place of a missing one.
    if image is None or max(image.size) <= 2:
        image = Image.open(_image_beside(path))
    image = image.convert("RGB")
    image.thumbnail((_MAX_TEXTURE, _MAX_TEXTURE))
    return np.asarray(image) / 255.0


def _image_beside(path: Path) -> Path:
    """Return the only diffuse or only other image in the folder of a scan, or in its ``tex``."""
    for pattern in ("*_dif*", "tex/*_dif*", "*", "tex/*"):
        files = path.parent.glob(pattern)
        images = [file for file in files if file.suffix.lower() in PHOTO_SUFFIXES]
        if len(images) == 1:
            return images[0]
    raise DyngsError(f"{path}: has no texture; put one image beside it or into its folder tex")
