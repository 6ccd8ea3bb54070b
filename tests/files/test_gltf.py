"""Documents of glTF: what is added is found where the document says it is."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import trimesh

from dyngs.files.gltf import INDICES, VERTICES, GlbDocument


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
    found = trimesh.load(io.BytesIO((tmp_path / "x.glb").read_bytes()), file_type="glb", process=False)
    (mesh,) = found.geometry.values()  # pyright: ignore[reportAttributeAccessIssue]
    np.testing.assert_array_equal(mesh.vertices, points)
    np.testing.assert_array_equal(mesh.faces.ravel(), faces)
    assert note == 0
    assert len((tmp_path / "x.glb").read_bytes()) % 4 == 0
