"""glTF's ``KHR_gaussian_splatting`` (release candidate of July 2026) in a ``.glb``: float32,
nothing is lost.

A primitive of points with the attributes ``KHR_gaussian_splatting:ROTATION`` (xyzw), ``SCALE``
(linear), ``OPACITY`` and ``SH_DEGREE_l_COEF_n`` up to degree 3, and ``COLOR_0`` (linear RGB) for
viewers that know only points. y is up.

With ``KHR_gaussian_splatting_compression_spz_2`` (a draft of 2025), all of them are in a .spz
within the file, whose axes are those of the document, as CesiumJS takes them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.core.conventions import SH_C0, RasterizeMode, num_sh_terms, srgb_decoded
from dyngs.core.gaussians import Gaussians
from dyngs.io.fields import require_at_most
from dyngs.io.formats.similarity import joined, similarity_of_matrix
from dyngs.io.formats.splat_file import (
    MOST_GAUSSIANS,
    SplatFile,
    described,
    from_linear,
    header_comments,
    stored_comments,
)
from dyngs.io.formats.spz import packed_spz, unpacked_spz
from dyngs.io.gltf import VERTICES, GlbDocument, GltfFile, Node, Primitive

EXTENSION = "KHR_gaussian_splatting"
# the draft has both names
_COMPRESSIONS = f"{EXTENSION}_compression_spz_2", f"{EXTENSION}_compression_spz"
_PROPERTIES = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
_POINTS = 0
# limits on the nodes that are visited, and on those above one another
_MOST_NODES, _MOST_DEPTH = 4096, 32


def read_gltf(path: Path) -> SplatFile:
    """Read all Gaussians of a .glb, placed as its nodes say.

    Raises DyngsError: no primitive of Gaussians, a kernel or colour space other than those of 3DGS,
    or damaged contents.
    """
    file = GltfFile(path)
    found: list[Gaussians] = []
    mode = RasterizeMode.CLASSIC
    for primitive, world in _primitives(file):
        compressed = _compressed(file, primitive)
        if compressed is not None:
            mode = compressed.mode
        place = similarity_of_matrix(world)
        if place is None:
            raise file.error(
                "a node distorts or mirrors its Gaussians; apply its transform before exporting"
            )
        own = _gaussians(file, primitive) if compressed is None else compressed.gaussians
        found.append(place.gaussians(own.replace(means=own.means.double())))
    if not found:
        raise file.error(f"holds no Gaussians ({EXTENSION})")
    return described(
        SplatFile(joined(found), mode, comments=stored_comments(file.document.asset.extras))
    )


def write_gltf(path: Path, splat: SplatFile) -> None:
    """Write a .glb with one primitive of Gaussians, harmonics up to degree 3."""
    document = GlbDocument()
    document.json["extensionsUsed"] = [EXTENSION]
    _write_primitive(path, splat, document, add_gaussians(document, splat.gaussians))


def write_compressed(path: Path, splat: SplatFile) -> None:
    """Write a .glb whose Gaussians are compressed as a .spz; readers that do not know that show
    nothing.

    Raises DyngsError as ``packed_spz`` does.
    """
    document = GlbDocument()
    view = document.add_bytes(packed_spz(splat))
    gaussians = splat.gaussians
    # of which only the shapes count
    arrays = {"POSITION": gaussians.means, "COLOR_0": gaussians.quats}
    arrays |= {f"{EXTENSION}:SCALE": gaussians.means, f"{EXTENSION}:ROTATION": gaussians.quats}
    for degree in range(1, gaussians.sh_degree + 1):
        arrays |= {
            f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k}": gaussians.means
            for k in range(2 * degree + 1)
        }
    attributes = {
        name: document.add_placeholder(array.numpy(), limits=name == "POSITION")
        for name, array in arrays.items()
    }
    own = _PROPERTIES | {"extensions": {_COMPRESSIONS[0]: {"bufferView": view}}}
    document.json["extensionsUsed"] = document.json["extensionsRequired"] = [
        EXTENSION,
        _COMPRESSIONS[0],
    ]
    primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: own}}
    _write_primitive(path, splat, document, primitive)


def _write_primitive(
    path: Path, splat: SplatFile, document: GlbDocument, primitive: dict[str, Any]
) -> None:
    """Write a document with one mesh in one node."""
    document.json["asset"]["extras"] = header_comments(splat)
    document.json |= {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
    }
    document.write(path)


def add_gaussians(document: GlbDocument, gaussians: Gaussians) -> dict[str, Any]:
    """Add the numbers of Gaussians to a document, harmonics up to degree 3; return their
    primitive."""
    sh = gaussians.sh.numpy()
    linear = srgb_decoded((sh[:, 0] * SH_C0 + 0.5).clip(0, 1))
    arrays = {
        "POSITION": gaussians.means.numpy(),
        "COLOR_0": np.concatenate([linear, gaussians.opacities.numpy()[:, None]], axis=1),
        f"{EXTENSION}:ROTATION": gaussians.quats.numpy()[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": gaussians.scales.numpy(),
        f"{EXTENSION}:OPACITY": gaussians.opacities.numpy()[:, None],
    }
    for degree in range(gaussians.sh_degree + 1):
        first = num_sh_terms(degree - 1)
        for k in range(first, num_sh_terms(degree)):
            arrays[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - first}"] = sh[:, k]
    attributes = {
        name: document.add_numbers(
            values.astype(np.float32, copy=False), VERTICES, limits=name == "POSITION"
        )
        for name, values in arrays.items()
    }
    return {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: _PROPERTIES}}


def _primitives(file: GltfFile) -> Iterator[tuple[Primitive, np.ndarray]]:
    """Yield the primitives of Gaussians, and the matrices (4, 4) by which nodes place them."""
    document = file.document
    nodes = document.nodes
    visited = 0
    roots = document.scenes[document.scene].nodes if document.scenes else range(len(nodes))
    waiting = [(node, np.eye(4), 0) for node in roots]
    while waiting:
        index, above, depth = waiting.pop()
        visited += 1
        if depth > _MOST_DEPTH or visited > _MOST_NODES:
            raise file.error(
                f"has more than {_MOST_NODES} nodes or {_MOST_DEPTH} of them above one another"
            )
        node = nodes[index]
        world = above @ _matrix(node)
        waiting += [(child, world, depth + 1) for child in node.children]
        for primitive in () if node.mesh is None else document.meshes[node.mesh].primitives:
            if EXTENSION in primitive.extensions:
                yield primitive, world


def _matrix(node: Node) -> np.ndarray:
    """Return the transform (4, 4) of a node; a rotation of zeros counts as none."""
    from scipy.spatial.transform import Rotation

    if node.matrix is not None:
        return np.array(node.matrix).reshape(4, 4).T
    matrix = np.eye(4)
    if np.linalg.norm(node.rotation) > 1e-6:
        matrix[:3, :3] = Rotation.from_quat(node.rotation).as_matrix()
    matrix[:3, :3] *= node.scale
    matrix[:3, 3] = node.translation
    return matrix


def _compressed(file: GltfFile, primitive: Primitive) -> SplatFile | None:
    """Return the Gaussians of the .spz that a primitive names; None: they are not compressed.

    Raises DyngsError: compressed in another way, or a kernel or colour space other than those of
    3DGS.
    """
    own = primitive.extensions[EXTENSION]
    more = own.get("extensions", {}) if isinstance(own, dict) else None
    if not isinstance(own, dict) or not isinstance(more, dict):
        raise file.error(f"{EXTENSION} or its extensions are no object; export it again")
    # The draft of the compression leaves out both, which the base extension requires.
    is_optional = any(name in more for name in _COMPRESSIONS)
    for key in ("kernel", "colorSpace"):
        known = _PROPERTIES[key]
        if own.get(key, known if is_optional else None) != known:
            raise file.error(f"{key} {own.get(key)!r:.40} is not supported, only {known}")
    for name, value in more.items():
        if name not in _COMPRESSIONS:
            raise file.error(f"its Gaussians need {name!r:.80}, which is not supported")
        view = value.get("bufferView") if isinstance(value, dict) else None
        return unpacked_spz(file.path, file.view_bytes(view, name))
    return None


def _gaussians(file: GltfFile, primitive: Primitive) -> Gaussians:
    names = primitive.attributes

    def numbers(name: str, kind: str = "VEC3") -> np.ndarray:
        if name not in names:
            raise file.error(f"its Gaussians have no {name:.60}; export it again")
        found = file.numbers(names[name], kind, np.float32)
        require_at_most(file.path, len(found), MOST_GAUSSIANS, "Gaussians")
        return found

    terms = []
    for degree in range(4):
        keys = [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k}" for k in range(2 * degree + 1)]
        if degree and keys[0] not in names:
            break
        terms += [numbers(key) for key in keys]
    return from_linear(
        numbers("POSITION"),
        numbers(f"{EXTENSION}:ROTATION", "VEC4")[:, [3, 0, 1, 2]],
        numbers(f"{EXTENSION}:SCALE"),
        numbers(f"{EXTENSION}:OPACITY", "SCALAR")[:, 0],
        np.stack(terms, axis=1),
    )
