"""glTF documents: added buffers and accessors are read back from the declared offsets."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from dyngs.core.errors import DyngsError
from dyngs.io.gltf import INDICES, VERTICES, GlbDocument, GltfFile


def test_another_reader_finds_the_mesh(tmp_path: Path) -> None:
    """Parts of odd lengths, too: each begins at a multiple of four bytes."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
    faces = np.array([0, 2, 1, 0, 1, 3, 1, 2, 3], np.uint16)
    document = GlbDocument()
    note = document.add_bytes(b"seven..")
    attributes = {"POSITION": document.add_numbers(points, VERTICES, limits=True)}
    primitive = {"attributes": attributes, "indices": document.add_numbers(faces, INDICES)}
    document.json |= {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
    }
    document.write(tmp_path / "x.glb")
    found = trimesh.load(
        io.BytesIO((tmp_path / "x.glb").read_bytes()), file_type="glb", process=False
    )
    (mesh,) = found.geometry.values()  # pyright: ignore[reportAttributeAccessIssue]
    np.testing.assert_array_equal(mesh.vertices, points)
    np.testing.assert_array_equal(mesh.faces.ravel(), faces)
    assert note == 0
    assert len((tmp_path / "x.glb").read_bytes()) % 4 == 0


def test_numbers_come_back_and_normalised_integers_as_fractions(tmp_path: Path) -> None:
    """Also where an accessor is a column of interleaved rows, and NaN, which the readers of formats
    judge."""
    document = GlbDocument()
    plain = np.array([[1.5, -2.0, np.nan], [0.0, 3.0, np.inf]], np.float32)
    first = document.add_numbers(plain)
    second = document.add_numbers(np.array([[0, 51, 102, 255]], np.uint8))
    document.write(tmp_path / "x.glb")
    size = int.from_bytes((tmp_path / "x.glb").read_bytes()[12:16], "little")
    changed = json.loads((tmp_path / "x.glb").read_bytes()[20 : 20 + size])
    changed["accessors"][second]["normalized"] = True
    changed["bufferViews"][first]["byteStride"] = 12
    changed["accessors"].append(
        {"bufferView": first, "byteOffset": 4, "componentType": 5126, "count": 2}
    )
    changed["accessors"][-1]["type"] = "SCALAR"
    changed["buffers"][0]["uri"] = "x.bin"
    (tmp_path / "x.bin").write_bytes((tmp_path / "x.glb").read_bytes()[28 + size :])
    (tmp_path / "x.gltf").write_text(json.dumps(changed))
    for file in (GltfFile(tmp_path / "x.glb"), GltfFile(tmp_path / "x.gltf")):
        np.testing.assert_array_equal(file.numbers(first, "VEC3"), plain)
        assert file.numbers(first, "VEC3", np.float32).dtype == np.float32
    np.testing.assert_allclose(file.numbers(second, "VEC4"), [[0, 0.2, 0.4, 1]])
    np.testing.assert_array_equal(file.numbers(2, "SCALAR")[:, 0], [-2.0, 3.0])
    with pytest.raises(DyngsError, match=r"accessor 0 must hold SCALAR, not 'VEC3'"):
        file.numbers(first, "SCALAR")
