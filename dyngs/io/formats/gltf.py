"""glTF's ``KHR_gaussian_splatting`` (release candidate of July 2026) in a ``.glb``: float32,
nothing is lost.

A primitive of points with the attributes ``KHR_gaussian_splatting:ROTATION`` (xyzw), ``SCALE``
(linear), ``OPACITY`` and ``SH_DEGREE_l_COEF_n`` up to degree 3, and ``COLOR_0`` (linear RGB) for
viewers that know only points. y is up.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.core.conventions import SH_C0, decode_srgb, num_sh_terms
from dyngs.core.gaussians import Gaussians
from dyngs.io.fields import require_at_most
from dyngs.io.formats.similarity import join_gaussians, similarity_from_matrix
from dyngs.io.formats.splat_file import (
    MAX_GAUSSIANS,
    SplatFile,
    comments_from_json,
    from_linear,
    header_comments,
    parse_comments,
)
from dyngs.io.gltf import VERTICES, GlbDocument, GltfFile

EXTENSION = "KHR_gaussian_splatting"
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
    """Read all Gaussians of a .glb, transformed by its nodes.

    Raises DyngsError: no primitive of Gaussians, a kernel or colour space other than those of 3DGS,
    or damaged contents.
    """
    file = GltfFile(path)
    found: list[Gaussians] = []
    for primitive, world in _primitives(file):
        place = similarity_from_matrix(world)
        if place is None:
            raise file.error(
                "a node transform shears or mirrors its Gaussians; apply it before exporting"
            )
        own = _gaussians(file, primitive)
        found.append(place.gaussians(own.replace(means=own.means.double())))
    if not found:
        raise file.error(f"no Gaussians found ({EXTENSION})")
    comments = comments_from_json(file.json["asset"].get("extras"))
    return parse_comments(SplatFile(join_gaussians(found), comments=comments))


def write_gltf(path: Path, splat: SplatFile) -> None:
    """Write a .glb with one primitive of Gaussians, harmonics up to degree 3."""
    document = GlbDocument()
    document.json["extensionsUsed"] = [EXTENSION]
    document.json["asset"]["extras"] = header_comments(splat)
    document.json |= {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [add_gaussians(document, splat.gaussians)]}],
    }
    document.write(path)


def add_gaussians(document: GlbDocument, gaussians: Gaussians) -> dict[str, Any]:
    """Add the numbers of Gaussians to a document, harmonics up to degree 3; return their
    primitive."""
    sh = gaussians.sh.numpy()
    linear = decode_srgb((sh[:, 0] * SH_C0 + 0.5).clip(0, 1))
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


def _primitives(file: GltfFile) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """Yield the primitives of Gaussians, and the matrices (4, 4) by which nodes place them."""
    nodes = file.nodes
    scenes = file.json.get("scenes")
    roots = scenes[file.json.get("scene", 0)].get("nodes", []) if scenes else range(len(nodes))
    waiting = [(node, np.eye(4), 0) for node in roots]
    visited = 0
    while waiting:
        index, above, depth = waiting.pop()
        visited += 1
        if depth > _MOST_DEPTH or visited > _MOST_NODES:
            raise file.error(
                f"has more than {_MOST_NODES} nodes, or nodes nested deeper than {_MOST_DEPTH}"
            )
        node = nodes[index]
        world = above @ _matrix(node)
        waiting += [(child, world, depth + 1) for child in node.get("children", [])]
        if "mesh" in node:
            for primitive in file.json["meshes"][node["mesh"]]["primitives"]:
                if EXTENSION in primitive.get("extensions", {}):
                    yield primitive, world


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """Return the transform (4, 4) of a node; a rotation of zeros counts as none."""
    from scipy.spatial.transform import Rotation

    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    rotation = node.get("rotation", (0, 0, 0, 1))
    if np.linalg.norm(rotation) > 1e-6:
        matrix[:3, :3] = Rotation.from_quat(rotation).as_matrix()
    matrix[:3, :3] *= node.get("scale", 1)
    matrix[:3, 3] = node.get("translation", 0)
    return matrix


def _gaussians(file: GltfFile, primitive: dict[str, Any]) -> Gaussians:
    own = primitive["extensions"][EXTENSION]
    if own.get("extensions"):
        raise file.error(
            f"its Gaussians need {', '.join(own['extensions']):.80}, which is not supported"
        )
    for key in ("kernel", "colorSpace"):
        if own.get(key) != _PROPERTIES[key]:
            raise file.error(
                f"{key} {own.get(key)!r:.40} is not supported, only {_PROPERTIES[key]}"
            )
    names = primitive["attributes"]

    def numbers(name: str, kind: str = "VEC3") -> np.ndarray:
        found = file.numbers(names[f"{EXTENSION}:{name}"], kind, np.float32)
        require_at_most(file.path, len(found), MAX_GAUSSIANS, "Gaussians")
        return found

    terms = []
    for degree in range(4):
        keys = [f"SH_DEGREE_{degree}_COEF_{k}" for k in range(2 * degree + 1)]
        if degree and f"{EXTENSION}:{keys[0]}" not in names:
            break
        terms += [numbers(key) for key in keys]
    return from_linear(
        file.numbers(names["POSITION"], "VEC3", np.float32),
        numbers("ROTATION", "VEC4")[:, [3, 0, 1, 2]],
        numbers("SCALE"),
        numbers("OPACITY", "SCALAR")[:, 0],
        np.stack(terms, axis=1),
    )
