"""Points beside a transforms file: which file is read, and files that are no points."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dyngs.data.readers.blender import read_blender
from dyngs.data.readers.nerfstudio import read_nerfstudio
from dyngs.data.readers.shared.point_files import find_points, read_points
from dyngs.data.readers.shared.transforms import FrameFile
from dyngs.errors import DyngsError
from dyngs.files.containment import staying_within


def write_ply(path: Path, count: int) -> Path:
    header = ["ply", "format ascii 1.0", f"element vertex {count}", *[f"property float {axis}" for axis in "xyz"]]
    path.write_text("\n".join([*header, "end_header", *["1 2 3"] * count]) + "\n")
    return path


def names_file(root: Path, named: str | None = None) -> FrameFile:
    return FrameFile(root / "transforms.json", {} if named is None else {"ply_file_path": named}, ())


@pytest.mark.parametrize(
    ("files", "named", "read"),
    [
        (["points3d.ply", "fused.ply", "other.ply"], None, "points3d.ply"),
        (["fused.ply", "points.ply"], None, "fused.ply"),
        (["scan.ply"], None, "scan.ply"),
        (["scan.ply", "points.ply"], None, "points.ply"),
        (["scan.ply", "points3d.ply"], "scan.ply", "scan.ply"),
        (["scan.ply", "other.ply"], None, None),
        ([], None, None),
    ],
)
def test_which_file_is_read(tmp_path: Path, files: list[str], named: str | None, read: str | None) -> None:
    """The key wins, then the usual names in their order, then an only file."""
    for count, name in enumerate(files, 1):
        write_ply(tmp_path / name, count)
    found = find_points(names_file(tmp_path, named))
    assert found.warnings == ()
    if read is None:
        assert (found.points, found.path) == (None, None)
        return
    assert found.points is not None
    assert (found.path, len(found.points.xyz)) == (tmp_path / read, 1 + files.index(read))
    np.testing.assert_array_equal(found.points.rgb, np.full_like(found.points.rgb, 128))


def test_a_named_file_must_be_there_and_a_found_one_may_be_broken(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"gone\.ply: no such point file"):
        find_points(names_file(tmp_path, "gone.ply"))
    (tmp_path / "points3d.ply").write_bytes(b"no points")
    found = find_points(names_file(tmp_path))
    assert found.points is None
    assert "points3d.ply: cannot be read" in found.warnings[0]


def test_a_link_that_leads_out_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "points3d.ply").symlink_to(write_ply(tmp_path / "own.ply", 3))
    with staying_within(tmp_path / "capture"):
        found = find_points(names_file(tmp_path / "capture"))
    assert found.points is None
    assert "points3d.ply" in found.warnings[0]


def test_both_json_formats_read_them(blender_root: Path, nerfstudio_root: Path) -> None:
    for root, read in ((blender_root, read_blender), (nerfstudio_root, read_nerfstudio)):
        assert read(root).points is None
        write_ply(root / "points3d.ply", 4)
        capture = read(root)
        assert capture.points is not None
        assert (len(capture.points.xyz), capture.points_file) == (4, root / "points3d.ply")
        (root / "points3d.ply").unlink()
    fields = json.loads((blender_root / "transforms_train.json").read_text()) | {"ply_file_path": "own.ply"}
    (blender_root / "transforms_train.json").write_text(json.dumps(fields))
    own = write_ply(blender_root / "own.ply", 1)
    assert read_blender(blender_root).points_file == own


@pytest.mark.parametrize(
    "content", [None, b"", b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n", b"\x00" * 99]
)
def test_bad_point_files_are_named(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "points.ply"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DyngsError, match=r"points\.ply"):
        read_points(path)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1099511627776\nproperty float x\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float q\nend_header\n0\n",
        b"PK\x03\x04 an archive",
        b"# an .obj\nmtllib ../../own.mtl\nv 0 0 0\n",
    ],
    ids=["empty", "huge", "no xyz", "zip", "obj"],
)
def test_points_that_are_no_ply_are_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "points.ply"
    path.write_bytes(content)
    with pytest.raises(DyngsError, match=r"points\.ply: cannot be read \(.*it must be a \.ply file of points"):
        read_points(path)


def test_textures_that_points_name_are_not_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = ["ply", "format ascii 1.0", "comment TextureFile ../own.png", "element vertex 3"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "s", "t")]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    lines += ["0 0 0 0 0", "1 0 0 0 0", "0 1 0 0 0", "3 0 1 2"]
    (tmp_path / "capture").mkdir()
    (tmp_path / "own.png").write_bytes(b"no image")
    (tmp_path / "capture" / "points.ply").write_text("\n".join(lines) + "\n")
    monkeypatch.setattr("PIL.Image.open", lambda *_: pytest.fail("a texture is opened"))
    assert read_points(tmp_path / "capture" / "points.ply").xyz.shape == (3, 3)
