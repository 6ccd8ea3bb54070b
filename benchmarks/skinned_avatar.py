"""Skinned avatars of ``.glb`` files, for ``clothed_people.py``.

Local letters: M vertices, T triangles, S joints.
"""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from dyngs.core.errors import DyngsError
from dyngs.human.body.mesh import normalized
from dyngs.human.motion.retarget import match_joints
from dyngs.io.gltf import GltfFile


@dataclass(frozen=True)
class Avatar:
    """A skinned mesh in its rest pose in the world, m; float64.

    Attributes:
        vertices, normals: (M, 3).
        uv: (M, 2), the origin at the top left.
        faces: (T, 3).
        paint: (T,) index into ``textures``.
        textures: images (H, W, 3) of sRGB values in [0, 1].
        weights: (M, S), rows sum to 1.
        joints: (S, 3).
        parents: (S,), -1 for a root.
        order: the joints, parents first.
        named: joints of SMPL-X by name.
    """

    vertices: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    faces: np.ndarray
    paint: np.ndarray
    textures: tuple[np.ndarray, ...]
    weights: np.ndarray
    joints: np.ndarray
    parents: np.ndarray
    order: tuple[int, ...]
    named: dict[str, int]

    @property
    def height(self) -> float:
        """From the lowest to the highest vertex, m."""
        return float(np.ptp(self.vertices[:, 1]))


def read_avatar(path: Path, gamma: float) -> Avatar:
    """Read the skinned meshes of a ``.glb``; ``gamma`` is the power that sRGB values of textures
    are raised to.

    Raises:
        DyngsError: no skin, joints of an unknown rig, or a person who does not face +z.
    """
    file = GltfFile(path)
    document, binary = _chunks(path)
    world = _node_matrices(file)
    node_ids = list(document["skins"][0]["joints"]) if document.get("skins") else []
    if not node_ids:
        raise DyngsError(f"{path}: has no skin; export the person with its skeleton")
    parts: dict[str, list[np.ndarray]] = {
        key: [] for key in ("vertices", "normals", "uv", "weights", "faces", "paint")
    }
    textures: list[np.ndarray] = []
    used: dict[int, int] = {}
    for node in document["nodes"]:
        if "mesh" not in node or "skin" not in node:
            continue
        skin = document["skins"][node["skin"]]
        bind = file.numbers(skin["inverseBindMatrices"], "MAT4").reshape(-1, 4, 4).swapaxes(1, 2)
        rest = np.stack([world[j] for j in skin["joints"]]) @ bind
        rows = [node_ids.index(j) for j in skin["joints"]]
        for piece in document["meshes"][node["mesh"]]["primitives"]:
            material = piece["material"]
            if material not in used:
                used[material] = len(textures)
                textures.append(_texture(document, binary, material) ** gamma)
            start = sum(map(len, parts["vertices"]))
            _add_piece(file, piece, rest, rows, len(node_ids), parts)
            parts["faces"].append(
                file.numbers(piece["indices"], "SCALAR").astype(np.int64).reshape(-1, 3) + start
            )
            parts["paint"].append(np.full(len(parts["faces"][-1]), used[material]))
    joints = np.stack([world[j][:3, 3] for j in node_ids])
    parents, order = _tree(file, node_ids)
    names = [document["nodes"][j].get("name", "") for j in node_ids]
    named = match_joints(path, names) | {
        f"{x.lower()}_eye": names.index(f"{x}Eye") for x in _eyes(names)
    }
    if joints[named["left_hip"], 0] <= joints[named["right_hip"], 0]:
        raise DyngsError(f"{path}: the person does not face +z at rest; turn it")
    whole = {key: np.concatenate(values) for key, values in parts.items()}
    return Avatar(
        **whole, textures=tuple(textures), joints=joints, parents=parents, order=order, named=named
    )


def _eyes(names: list[str]) -> list[str]:
    return [side for side in ("Left", "Right") if f"{side}Eye" in names]


def _add_piece(
    file: GltfFile,
    piece: dict,
    rest: np.ndarray,
    rows: list[int],
    joints: int,
    parts: dict[str, list[np.ndarray]],
) -> None:
    """Add the vertices of a primitive, skinned by ``rest`` (S', 4, 4) of the joints ``rows`` (S')
    of all ``joints``."""
    given = piece["attributes"]
    points, normals = (file.numbers(given[key], "VEC3") for key in ("POSITION", "NORMAL"))
    fraction = file.numbers(given["WEIGHTS_0"], "VEC4")
    owner = file.numbers(given["JOINTS_0"], "VEC4").astype(np.int64)
    weights = np.zeros((len(points), joints))
    fraction = fraction / fraction.sum(axis=1, keepdims=True)
    np.add.at(weights, (np.arange(len(points))[:, None], np.array(rows)[owner]), fraction)
    blended = np.einsum("mk,mkij->mij", fraction, rest[owner])
    parts["vertices"].append(
        np.einsum("mij,mj->mi", blended[:, :3, :3], points) + blended[:, :3, 3]
    )
    parts["normals"].append(normalized(np.einsum("mij,mj->mi", blended[:, :3, :3], normals)))
    parts["uv"].append(file.numbers(given["TEXCOORD_0"], "VEC2"))
    parts["weights"].append(weights)


def _chunks(path: Path) -> tuple[dict, bytes]:
    """Return the whole document of a ``.glb`` and its binary chunk."""
    content = path.read_bytes()
    size = int.from_bytes(content[12:16], "little")
    return json.loads(content[20 : 20 + size]), content[28 + size :]


def _texture(document: dict, binary: bytes, material: int) -> np.ndarray:
    """Return the colours (H, W, 3) in [0, 1] of a material, averaged down to at most 1024 texels
    per side."""
    base = document["materials"][material]["pbrMetallicRoughness"]
    view = document["images"][document["textures"][base["baseColorTexture"]["index"]]["source"]][
        "bufferView"
    ]
    place = document["bufferViews"][view]
    start = place.get("byteOffset", 0)
    image = Image.open(io.BytesIO(binary[start : start + place["byteLength"]])).convert("RGB")
    image = image.reduce(max(1, max(image.size) // 1024))
    return np.asarray(image, np.float64) / 255.0


def _node_matrices(file: GltfFile) -> list[np.ndarray]:
    """Return world_from_node (4, 4) of each node at rest."""
    nodes = file.nodes
    local = []
    for node in nodes:
        matrix = np.eye(4)
        if "matrix" in node:
            matrix = np.array(node["matrix"]).reshape(4, 4).T
        else:
            rotation = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1)))
            matrix[:3, :3] = rotation.as_matrix() * np.array(node.get("scale", 1))
            matrix[:3, 3] = node.get("translation", 0)
        local.append(matrix)
    world = list(local)
    children = {child for node in nodes for child in node.get("children", ())}
    waiting = [i for i in range(len(nodes)) if i not in children]
    while waiting:
        i = waiting.pop()
        for child in nodes[i].get("children", ()):
            world[child] = world[i] @ local[child]
            waiting.append(child)
    return world


def _tree(file: GltfFile, node_ids: list[int]) -> tuple[np.ndarray, tuple[int, ...]]:
    """Return the parents (S,) of the joints, -1 for a root, and the joints in an order with parents
    first."""
    row = {node: i for i, node in enumerate(node_ids)}
    parents = np.full(len(node_ids), -1)
    for node, i in row.items():
        for child in file.nodes[node].get("children", ()):
            if child in row:
                parents[row[child]] = i
    order = [i for i in range(len(parents)) if parents[i] < 0]
    for i in order:
        order.extend(np.flatnonzero(parents == i).tolist())
    return parents, tuple(order)


def posed_mesh(
    avatar: Avatar, rotations: np.ndarray, joints: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and normals (M, 3) of a frame with world rotations (S, 3, 3) and joints
    (S, 3)."""
    shifts = joints - np.einsum("sij,sj->si", rotations, avatar.joints)
    turned = (avatar.weights @ rotations.reshape(-1, 9)).reshape(-1, 3, 3)
    vertices = np.einsum("mij,mj->mi", turned, avatar.vertices) + avatar.weights @ shifts
    return vertices, normalized(np.einsum("mij,mj->mi", turned, avatar.normals))
