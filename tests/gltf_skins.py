"""A reader of glTF skins in plain numpy, as the standard describes them: positions of vertices in
frames of a clip."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class SkinnedGlb:
    """The document of a ``.glb`` with one skinned mesh of one primitive."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        magic, version, length = struct.unpack("<4sII", data[:12])
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack("<I4s", data[12:20])
        assert kind == b"JSON"
        assert size % 4 == 0
        self.json = json.loads(data[20 : 20 + size])
        rest, kind = struct.unpack("<I4s", data[20 + size : 28 + size])
        assert (kind, 28 + size + rest) == (b"BIN\0", len(data))
        assert self.json["buffers"] == [{"byteLength": rest}]
        self._data = data[28 + size :]
        self.primitive = self.json["meshes"][0]["primitives"][0]

    def numbers(self, index: int) -> np.ndarray:
        """The rows of an accessor."""
        accessor = self.json["accessors"][index]
        view = self.json["bufferViews"][accessor["bufferView"]]
        dtype = np.dtype(TYPES[accessor["componentType"]])
        width = WIDTHS[accessor["type"]]
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == accessor["count"] * width * dtype.itemsize
        found = np.frombuffer(
            self._data, dtype, accessor["count"] * width, view["byteOffset"]
        ).reshape(-1, width)
        if "min" in accessor:
            np.testing.assert_array_equal(found.min(axis=0), np.array(accessor["min"], dtype))
            np.testing.assert_array_equal(found.max(axis=0), np.array(accessor["max"], dtype))
        return found

    def attribute(self, name: str) -> np.ndarray:
        """The numbers of an attribute of the primitive."""
        return self.numbers(self.primitive["attributes"][name])

    def image(self) -> np.ndarray:
        """The first image, (H, W, 3)."""
        view = self.json["bufferViews"][self.json["images"][0]["bufferView"]]
        start = view["byteOffset"]
        return np.asarray(Image.open(io.BytesIO(self._data[start : start + view["byteLength"]])))

    @property
    def num_frames(self) -> int:
        """Keys of the animation."""
        sampler = self.json["animations"][0]["samplers"][0]
        return len(self.numbers(sampler["input"]))

    def weights(self) -> tuple[np.ndarray, np.ndarray]:
        """Joints and weights (V, K) of all sets."""
        sets = [k for k in range(8) if f"JOINTS_{k}" in self.primitive["attributes"]]
        joints = np.concatenate([self.attribute(f"JOINTS_{k}") for k in sets], axis=1)
        return joints, np.concatenate([self.attribute(f"WEIGHTS_{k}") for k in sets], axis=1)

    def skin_matrices(self, frame: int | None) -> np.ndarray:
        """The matrices (J, 4, 4) of the skin at a key of the animation; None: as the nodes
        stand."""
        nodes = [dict(node) for node in self.json["nodes"]]
        if frame is not None:
            animation = self.json["animations"][0]
            for channel in animation["channels"]:
                values = self.numbers(animation["samplers"][channel["sampler"]]["output"])
                nodes[channel["target"]["node"]][channel["target"]["path"]] = values[frame].tolist()
        world: dict[int, np.ndarray] = {}

        def place(index: int, above: np.ndarray) -> None:
            node = nodes[index]
            own = np.eye(4)
            own[:3, :3] = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
            own[:3, :3] *= node.get("scale", [1, 1, 1])
            own[:3, 3] = node.get("translation", [0, 0, 0])
            world[index] = above @ own
            for child in node.get("children", []):
                place(child, world[index])

        for root in self.json["scenes"][self.json["scene"]]["nodes"]:
            place(root, np.eye(4))
        skin = self.json["skins"][0]
        bind = self.numbers(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        return np.stack([world[joint] for joint in skin["joints"]]) @ bind

    def posed(self, frame: int | None) -> np.ndarray:
        """Positions (V, 3) in the scene."""
        joints, weights = self.weights()
        blend = np.einsum(
            "vk,vkab->vab", weights.astype(np.float64), self.skin_matrices(frame)[joints]
        )
        points = self.attribute("POSITION").astype(np.float64)
        return np.einsum("vab,vb->va", blend[:, :3, :3], points) + blend[:, :3, 3]
