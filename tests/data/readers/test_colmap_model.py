"""Model files of COLMAP: as COLMAP writes them, as other programs do, truncated, and damaged."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tiny_captures import write_colmap

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.readers.colmap import NUM_PARAMS, read_colmap, read_model

POINTS_2D = "1.5 2.5 -1 3 4 17"


@pytest.mark.parametrize("extension", [".bin", ".txt"])
def test_every_camera_model_that_pycolmap_writes(tmp_path: Path, extension: str) -> None:
    import pycolmap

    models = [
        model for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"
    ]
    scene = pycolmap.Reconstruction()
    expected = {}
    for number, model in enumerate(models, start=1):
        camera = pycolmap.Camera.create_from_model_id(number, model, 10.0, 12, 8)
        scene.add_camera_with_trivial_rig(camera)
        expected[number] = (model.name, (12, 8), tuple(camera.params))
    (scene.write_binary if extension == ".bin" else scene.write_text)(str(tmp_path))
    found, _, _ = read_model(tmp_path)
    assert {
        number: (camera.model, camera.size, camera.params) for number, camera in found.items()
    } == expected
    assert {name for name, _, _ in expected.values()} <= set(NUM_PARAMS)


def assert_refused(root: Path, path: Path) -> None:
    with pytest.raises(DyngsError) as caught:
        read_colmap(root)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_truncated_binary_file_is_one_line_that_names_it(colmap_root: Path, name: str) -> None:
    """Cut at many lengths; pycolmap hangs, aborts or silently reads nonsense at some of them."""
    path = colmap_root / "sparse/0" / f"{name}.bin"
    content = path.read_bytes()
    for length in [*range(0, len(content), max(1, len(content) // 40)), len(content) - 1]:
        path.write_bytes(content[:length])
        assert_refused(colmap_root, path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_truncated_text_file_is_one_line_that_names_it(tmp_path: Path, name: str) -> None:
    """Cut the file after each line; its header gives the expected number of entries."""
    root = write_colmap(tmp_path, "txt")
    path = root / "sparse/0" / f"{name}.txt"
    lines = path.read_text().splitlines(keepends=True)
    entries = [i for i, line in enumerate(lines) if not line.startswith("#")][
        :: 2 if name == "images" else 1
    ]
    for cut in entries:
        path.write_text("".join(lines[:cut]))
        assert_refused(root, path)
    path.write_text("".join(lines[: entries[-1]]) + lines[entries[-1]][:5])
    assert_refused(root, path)


def test_trailing_bytes_are_refused(colmap_root: Path) -> None:
    with (colmap_root / "sparse/0/points3D.bin").open("ab") as file:
        file.write(b"xyz")
    with pytest.raises(DyngsError, match=r"points3D\.bin: cannot be read"):
        read_colmap(colmap_root)


def test_image_of_an_unknown_camera(tmp_path: Path) -> None:
    root = write_colmap(tmp_path, "txt")
    path = root / "sparse/0/images.txt"
    path.write_text(path.read_text().replace(" 2 left/01.jpg", " 77 left/01.jpg"))
    with pytest.raises(
        DyngsError,
        match=r"images\.txt: left/01\.jpg refers to camera 77, which is not in cameras\.txt",
    ):
        read_colmap(root)


def test_missing_files_of_the_model(colmap_root: Path) -> None:
    (colmap_root / "sparse/0/points3D.bin").unlink()
    with pytest.raises(DyngsError, match=r"points3D\.bin: file missing from the COLMAP model"):
        read_colmap(colmap_root)


@pytest.mark.parametrize("extension", ["bin", "txt"])
def test_names_in_latin_1_are_one_line(tmp_path: Path, extension: str) -> None:
    root = write_colmap(tmp_path, extension)
    path = root / f"sparse/0/images.{extension}"
    path.write_bytes(path.read_bytes().replace(b"left/01.jpg", b"l\xe9ft/01.jpg"))
    with pytest.raises(DyngsError, match=r"sparse/0\S*: cannot be read \(.*(UTF-8|utf-8)"):
        read_capture(DataConfig(root=root))  # type: ignore[call-arg]


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_counts_that_no_file_has(colmap_root: Path, name: str) -> None:
    path = colmap_root / f"sparse/0/{name}.bin"
    data = path.read_bytes()
    for count in (2**63, 2**64 - 1, 2**31):
        path.write_bytes(struct.pack("<Q", count) + data[8:])
        with pytest.raises(DyngsError, match=rf"{name}\.bin: cannot be read"):
            read_colmap(colmap_root)


def pose_line(number: int, name: str = "") -> str:
    return f"{number} 1.0 0 0 0 {number}.5 -2e-001 3 1 {name or f'{number}.png'}"


def write_text_model(folder: Path, images: bytes, points: str = "") -> Path:
    (folder / "cameras.txt").write_text("1 PINHOLE 12 8 10 11 6 4\n")
    (folder / "images.txt").write_bytes(images)
    (folder / "points3D.txt").write_text(points)
    return folder


def lines_of(*seconds: str | None) -> list[str]:
    """Lines of one image for each second line; None: the line is missing."""
    lines = []
    for number, second in enumerate(seconds, start=1):
        lines += [pose_line(number)] if second is None else [pose_line(number), second]
    return lines


@pytest.mark.parametrize(
    "seconds",
    [
        (POINTS_2D, POINTS_2D, POINTS_2D),
        ("", "", ""),
        (None, None, None),
        ("", POINTS_2D, None),
        (None, POINTS_2D, None),
        (POINTS_2D, None, POINTS_2D),
        ("", None, ""),
    ],
)
@pytest.mark.parametrize(
    "header", ["", "# Image list\n# Number of images: 3, mean observations per image: 0\n"]
)
@pytest.mark.parametrize(
    "encode",
    [
        lambda text: text.encode(),
        lambda text: text.replace("\n", "\r\n").encode(),
        lambda text: text.encode("utf-8-sig") + b"\n\n\n",
        lambda text: text.replace("\n", "\r\r\n").encode(),
        lambda text: text.encode("utf-16"),
        lambda text: text.encode("utf-16-le"),
    ],
    ids=[
        "plain",
        "crlf",
        "mark_and_blank_lines",
        "blank_lines_between",
        "utf16",
        "utf16_without_mark",
    ],
)
def test_second_lines_of_images_may_be_missing(
    tmp_path: Path, seconds: tuple[str | None, ...], header: str, encode: Callable[[str], bytes]
) -> None:
    _, images, _points = read_model(
        write_text_model(tmp_path, encode(header + "\n".join(lines_of(*seconds)) + "\n"))
    )
    assert [image.name for image in images] == ["1.png", "2.png", "3.png"]
    assert [image.pose[4:] for image in images] == [(number + 0.5, -0.2, 3) for number in (1, 2, 3)]


@pytest.mark.parametrize("second", [None, "", POINTS_2D])
def test_names_are_the_rest_of_the_line(tmp_path: Path, second: str | None) -> None:
    names = ["12", "a b/c (1) 2.png", "cam0\\7 8 9.png", "写真 1.png"]
    lines = []
    for number, name in enumerate(names, start=1):
        lines += [pose_line(number, name)] if second is None else [pose_line(number, name), second]
    _, images, _points = read_model(write_text_model(tmp_path, "\n".join(lines).encode()))
    assert [image.name for image in images] == sorted(names)


@pytest.mark.parametrize(
    ("lines", "line"),
    [
        ([pose_line(1), POINTS_2D, POINTS_2D], 3),  # two lines of points
        ([POINTS_2D, pose_line(1)], 1),
        ([pose_line(1), "1.5 2.5 -1 3 4"], 2),  # a point is cut off
        ([pose_line(1), "2 0.9 0.1"], 2),  # an image is cut off
        ([pose_line(1), "2 1 0 0 0 x 0 0 1 a.png"], 2),
    ],
)
def test_lines_that_fit_no_image_are_refused(tmp_path: Path, lines: list[str], line: int) -> None:
    write_text_model(tmp_path, "\n".join(lines).encode())
    with pytest.raises(
        DyngsError, match=rf"images\.txt, line {line}: the line is truncated or damaged"
    ):
        read_model(tmp_path)


def test_tracks_of_points_do_not_count(tmp_path: Path) -> None:
    """Photos of a track may be absent, and their points, too."""
    text = "7 1.5 2 -3 10 20 255 0.5 99 0 1 12\n3 4e+000 5 6 1.0 2.0 3.0 0.1\n"
    _, _images, points = read_model(write_text_model(tmp_path, pose_line(1).encode(), text))
    # in order of their ids
    np.testing.assert_array_equal(points.xyz, [[4, 5, 6], [1.5, 2, -3]])
    np.testing.assert_array_equal(points.rgb, [[1, 2, 3], [10, 20, 255]])


def test_tracks_of_absent_images_in_binary_files(colmap_root: Path) -> None:
    expected = read_colmap(colmap_root).points
    path = colmap_root / "sparse/0/points3D.bin"
    data = bytearray(path.read_bytes())
    data[8 + 51 : 8 + 55] = struct.pack("<I", 12345)  # the first image of the first track
    path.write_bytes(data)
    found = read_colmap(colmap_root).points
    assert expected is not None
    assert found is not None
    np.testing.assert_array_equal(found.xyz, expected.xyz)
    np.testing.assert_array_equal(found.rgb, expected.rgb)


def test_parameters_that_a_camera_lacks(tmp_path: Path) -> None:
    write_text_model(tmp_path, pose_line(1).encode())
    (tmp_path / "cameras.txt").write_text("# cameras\n\n1 PINHOLE 12 8 10 11 6\n")
    with pytest.raises(DyngsError, match=r"cameras\.txt, line 3: the line is truncated or damaged"):
        read_model(tmp_path)
