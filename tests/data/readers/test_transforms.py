"""Transforms files: frames, intrinsics, points beside them."""

from __future__ import annotations

import json
import unicodedata
from pathlib import Path

import numpy as np
import pytest
from tiny_captures import random_pixels, write_frames, write_image

from dyngs.api.load import read_capture
from dyngs.capture.inspection import format_report, inspect_capture
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.loader import ImageLoader
from dyngs.data.readers.transforms import (
    FrameFile,
    find_points,
    read_blender,
    read_nerfstudio,
    read_points,
)
from dyngs.io.containment import restrict_paths_to

ODD = (
    *(
        "5e-324",
        "1e-300",
        "1e-5",
        "0",
        "-0.0",
        "-1",
        "3.14159265358979",
        "4",
        "1e7",
        "1e15",
        "1e308",
        "1e400",
        "-1e400",
    ),
    *(
        "NaN",
        "-Infinity",
        "1" + "0" * 400,
        "1" + "0" * 5000,
        "9007199254740993",
        "18446744073709551616",
        "true",
        "null",
    ),
    *(
        '""',
        '"/"',
        '"x"',
        '"\\u0000"',
        '"\\ud800"',
        '"\\u001b[2J"',
        "[]",
        "{}",
        "[[]]",
        "[1, 2, 3, 4]",
        '{"a": [1]}',
    ),
    *(
        "[" * 500 + "]" * 500,
        "[" * 200_000,
        "[[1,0,0,0],[0,1,0,0],[0,0,1,1e300],[0,0,0,1]]",
        "[[1,2],[3]]",
    ),
)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two images with every field that is read."""
    names = [f"images/{i}.png" for i in range(2)]
    for i, name in enumerate(names):
        write_image(tmp_path / name, random_pixels(8, 12, 3, seed=i))
    lens = {
        "w": 12,
        "h": 8,
        "fl_x": 10.0,
        "fl_y": 11.0,
        "cx": 6.0,
        "cy": 4.0,
        "k1": 0.01,
        "p1": 0.001,
    }
    shared = {
        **lens,
        "camera_model": "OPENCV",
        "train_filenames": names[:1],
        "val_filenames": names[1:],
        "fps": 30,
    }
    write_frames(tmp_path / "transforms.json", names, shared)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for i, frame in enumerate(content["frames"]):
        frame.update(
            time=i / 3, frame=i, camera=0, mask_path=names[i], camera_angle_x=1.0, is_fisheye=False
        )
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    return tmp_path


def use(root: Path) -> str:
    """Read, inspect and load the capture; the line of the refusal, if there is one."""
    report = inspect_capture(root)
    assert "\n" not in "".join(report.problems)
    format_report(report)
    try:
        capture = read_capture(DataConfig(root=root))  # type: ignore[call-arg]
        for view in capture.splits["train"]:
            assert np.isfinite(view.intrinsics).all()
            assert np.isfinite(view.cam_from_world).all()
        image = ImageLoader(capture.splits["train"], DataConfig(root=root))[0]  # type: ignore[call-arg]
        assert bool(image.rgb_premultiplied.isfinite().all())
    except DyngsError as error:
        return str(error)
    return ""


KEYS = (
    "w",
    "h",
    "fl_x",
    "cx",
    "k1",
    "p1",
    "camera_model",
    "train_filenames",
    "frames",
    "ply_file_path",
    "fps",
)
OWN = (
    "file_path",
    "transform_matrix",
    "time",
    "frame",
    "camera",
    "mask_path",
    "fl_x",
    "w",
    "is_fisheye",
)


@pytest.mark.parametrize("key", [*KEYS, *(f"frames/{key}" for key in OWN)])
def test_no_value_of_any_key_ends_in_a_traceback(root: Path, key: str) -> None:
    path = root / "transforms.json"
    content = json.loads(path.read_text())
    (content["frames"][1] if key.startswith("frames/") else content)[key.rpartition("/")[2]] = "@@"
    lines = []
    for value in ODD:
        path.write_text(json.dumps(content).replace('"@@"', value))
        lines.append(use(root))
    assert [line for line in lines if line and (str(root) not in line or "\n" in line)] == []


@pytest.mark.parametrize("angle", ["5e-324", "1e-300", "1e-9", "3.14159265358979"])
def test_a_field_of_view_that_no_camera_has(root: Path, angle: str) -> None:
    """The smallest ended in a division by zero."""
    path = root / "transforms.json"
    content = json.loads(path.read_text())
    for key in ("fl_x", "fl_y"):
        del content[key]
    for frame in content["frames"]:
        frame["camera_angle_x"] = "@@"
    path.write_text(json.dumps(content).replace('"@@"', angle))
    assert "transforms.json, frame 0 (images/0.png): the focal length (" in use(root)
    assert "field of view" in use(root)


def test_sizes_that_no_image_has(root: Path) -> None:
    path = root / "transforms.json"
    path.write_text(path.read_text().replace('"w": 12', '"w": 1e9'))
    assert "w and h must be from 1 to 1,048,576, got 1e+09 and 8" in use(root)


def write_ply(path: Path, count: int) -> Path:
    header = [
        "ply",
        "format ascii 1.0",
        f"element vertex {count}",
        *[f"property float {axis}" for axis in "xyz"],
    ]
    path.write_text("\n".join([*header, "end_header", *["1 2 3"] * count]) + "\n")
    return path


def names_file(root: Path, named: str | None = None) -> FrameFile:
    return FrameFile(
        root / "transforms.json", (), {} if named is None else {"ply_file_path": named}
    )


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
def test_which_file_is_read(
    tmp_path: Path, files: list[str], named: str | None, read: str | None
) -> None:
    """The key wins, then the usual names in their order, then an only file."""
    for count, name in enumerate(files, 1):
        write_ply(tmp_path / name, count)
    points, path, warnings = find_points(names_file(tmp_path, named))
    assert warnings == []
    if read is None:
        assert (points, path) == (None, None)
        return
    assert points is not None
    assert (path, len(points.xyz)) == (tmp_path / read, 1 + files.index(read))
    np.testing.assert_array_equal(points.rgb, np.full_like(points.rgb, 128))


@pytest.mark.parametrize(
    "written",
    [
        "images\\Gärten 1.png",
        ".\\images\\Gärten 1",
        "C:\\scan\\images\\Gärten 1.png",
        "/elsewhere/images/Gärten 1.png",
        unicodedata.normalize("NFD", "images/Gärten 1.png"),
        "images/gärten 1.PNG",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_names_as_other_programs_write_them(tmp_path: Path, written: str, encoding: str) -> None:
    image = tmp_path / "images" / "Gärten 1.png"
    write_image(image, random_pixels(8, 12, 3))
    (tmp_path / "points").mkdir()
    write_ply(tmp_path / "points" / "cloud.ply", 3)
    folder = written.rpartition("images")[0]
    mask = folder + "masks\\a.png"
    write_image(tmp_path / "masks/a.png", random_pixels(8, 12, 1))
    frame = {"file_path": written, "mask_path": mask, "transform_matrix": np.eye(4).tolist()}
    fields = {
        "w": 12,
        "h": 8,
        "fl_x": 10.0,
        "ply_file_path": folder + "points\\cloud.ply",
        "frames": [frame],
    }
    (tmp_path / "transforms.json").write_bytes(
        json.dumps(fields, ensure_ascii=False).encode(encoding)
    )
    capture = read_nerfstudio(tmp_path)
    (view,) = capture.splits["train"]
    assert (view.image_path, view.mask_path) == (image, tmp_path / "masks/a.png")
    assert capture.points_file == tmp_path / "points/cloud.ply"


def test_a_named_file_must_be_there_and_a_found_one_may_be_broken(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"gone\.ply: no such point file"):
        find_points(names_file(tmp_path, "gone.ply"))
    (tmp_path / "points3d.ply").write_bytes(b"no points")
    points, _, warnings = find_points(names_file(tmp_path))
    assert points is None
    assert "points3d.ply: cannot be read" in warnings[0]


def test_a_link_that_leads_out_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "points3d.ply").symlink_to(write_ply(tmp_path / "own.ply", 3))
    with restrict_paths_to(tmp_path / "capture"):
        points, _, warnings = find_points(names_file(tmp_path / "capture"))
    assert points is None
    assert "points3d.ply" in warnings[0]


def test_both_json_formats_read_them(blender_root: Path, nerfstudio_root: Path) -> None:
    for root, read in ((blender_root, read_blender), (nerfstudio_root, read_nerfstudio)):
        assert read(root).points is None
        write_ply(root / "points3d.ply", 4)
        capture = read(root)
        assert capture.points is not None
        assert (len(capture.points.xyz), capture.points_file) == (4, root / "points3d.ply")
        (root / "points3d.ply").unlink()
    fields = json.loads((blender_root / "transforms_train.json").read_text()) | {
        "ply_file_path": "own.ply"
    }
    (blender_root / "transforms_train.json").write_text(json.dumps(fields))
    own = write_ply(blender_root / "own.ply", 1)
    assert read_blender(blender_root).points_file == own


@pytest.mark.parametrize(
    "content",
    [None, b"", b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n", b"\x00" * 99],
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
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 1099511627776\n"
            b"property float x\nend_header\n"
        ),
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float q\nend_header\n0\n",
        b"PK\x03\x04 an archive",
        b"# an .obj\nmtllib ../../own.mtl\nv 0 0 0\n",
    ],
    ids=["empty", "huge", "no xyz", "zip", "obj"],
)
def test_points_that_are_no_ply_are_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "points.ply"
    path.write_bytes(content)
    with pytest.raises(
        DyngsError, match=r"points\.ply: cannot be read \(.*it must be a \.ply file of points"
    ):
        read_points(path)


def test_textures_that_points_name_are_not_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = ["ply", "format ascii 1.0", "comment TextureFile ../own.png", "element vertex 3"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "s", "t")]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    lines += ["0 0 0 0 0", "1 0 0 0 0", "0 1 0 0 0", "3 0 1 2"]
    (tmp_path / "capture").mkdir()
    (tmp_path / "own.png").write_bytes(b"no image")
    (tmp_path / "capture" / "points.ply").write_text("\n".join(lines) + "\n")
    monkeypatch.setattr("PIL.Image.open", lambda *_: pytest.fail("a texture is opened"))
    assert read_points(tmp_path / "capture" / "points.ply").xyz.shape == (3, 3)
