from __future__ import annotations

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_captures import opengl_pose, random_pixels, write_colmap, write_image

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.data.images.lens import distort
from dyngs.data.readers.colmap import check_model_file, find_model, is_colmap, pinhole_and_lens, read_colmap
from dyngs.errors import DyngsError

MODELS = {
    "SIMPLE_PINHOLE": (10, 6, 4),
    "PINHOLE": (10, 11, 6, 4),
    "SIMPLE_RADIAL": (10, 6, 4, 0.1),
    "RADIAL": (10, 6, 4, 0.1, -0.05),
    "OPENCV": (10, 11, 6, 4, 0.1, -0.05, 0.01, -0.02),
    "FULL_OPENCV": (10, 11, 6, 4, 0.1, -0.05, 0.01, -0.02, 0.03, 0.04, -0.01, 0.005),
    "SIMPLE_FISHEYE": (10, 6, 4),
    "FISHEYE": (10, 11, 6, 4),
    "SIMPLE_RADIAL_FISHEYE": (10, 6, 4, 0.1),
    "RADIAL_FISHEYE": (10, 6, 4, 0.1, -0.05),
    "OPENCV_FISHEYE": (10, 11, 6, 4, 0.1, -0.05, 0.02, -0.01),
}


@pytest.mark.parametrize("model", MODELS)
def test_lens_images_points_where_colmap_does(model: str) -> None:
    """COLMAP itself is the ground truth for the meaning and order of every model's parameters."""
    import pycolmap

    if model not in pycolmap.CameraModelId.__members__:
        pytest.skip("this pycolmap does not know the model yet")
    camera = pycolmap.Camera(
        camera_id=1, model=getattr(pycolmap.CameraModelId, model), width=12, height=8, params=list(MODELS[model])
    )
    intrinsics, lens = pinhole_and_lens(camera, "here")
    rays = np.random.default_rng(1).uniform(-0.6, 0.6, (50, 2))
    rays[0] = 0
    wanted = camera.img_from_cam(np.column_stack([rays, np.ones(50)]))
    found = distort(lens, torch.from_numpy(rays)).numpy() @ intrinsics[:2, :2] + intrinsics[:2, 2]
    np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_number_of_parameters_of_every_model(tmp_path: Path) -> None:
    """The check of the binary file walks over cameras of each model that pycolmap can write."""
    import pycolmap

    models = [model for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"]
    scene = pycolmap.Reconstruction()
    for number, model in enumerate(models, start=1):
        scene.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_id(number, model, 10.0, 12, 8))
    scene.write_binary(str(tmp_path))
    check_model_file(tmp_path / "cameras.bin")
    check_model_file(tmp_path / "rigs.bin")


def test_unsupported_camera_models_say_what_to_do(tmp_path: Path) -> None:
    root = write_colmap(tmp_path, model="FOV", params=(10, 11, 6, 4, 0.5))
    with pytest.raises(DyngsError, match="FOV is not supported; run `colmap image_undistorter`"):
        read_colmap(root)


@pytest.mark.parametrize("extension", ["bin", "txt"])
def test_model_is_read_as_written(tmp_path: Path, extension: str) -> None:
    root = write_colmap(tmp_path, extension)
    assert is_colmap(root)
    capture = read_colmap(root)
    views = capture.splits["train"]
    assert [v.name for v in views] == [f"left/{i:02d}" for i in range(1, 9, 2)] + [
        f"right/{i:02d}" for i in range(0, 9, 2)
    ]
    assert {v.camera_id for v in views} == {1, 2}
    wanted = np.linalg.inv(opengl_pose(0.9) @ np.diag([1.0, -1, -1, 1]))
    np.testing.assert_allclose(views[1].cam_from_world, wanted, atol=1e-9)
    assert capture.points is not None
    np.testing.assert_allclose(capture.points.xyz, [[k, 2 * k, -1] for k in range(5)], atol=1e-12)
    np.testing.assert_array_equal(capture.points.rgb, [[k, 100, 200] for k in range(5)])
    assert capture.warnings == ()


@pytest.mark.parametrize("folder", ["sparse", "."])
def test_model_may_lie_in_sparse_or_at_the_root(colmap_root: Path, folder: str) -> None:
    for path in list((colmap_root / "sparse/0").iterdir()):
        path.rename(colmap_root / folder / path.name)
    assert len(read_colmap(colmap_root).splits["train"]) == 9


@pytest.mark.parametrize("name", ["right/00.jpg.png", "right/00.png", "right/00.jpg"])
def test_masks_are_found_by_any_usual_name(colmap_root: Path, name: str) -> None:
    write_image(colmap_root / "masks" / name, random_pixels(8, 12, 1))
    capture = read_colmap(colmap_root)
    found = {view.name: view.mask_path for view in capture.splits["train"]}
    assert found.pop("right/00") == colmap_root / "masks" / name
    assert set(found.values()) == {None}
    assert any("8 images have no mask" in warning for warning in capture.warnings)


def assert_refused(root: Path, path: Path) -> None:
    with pytest.raises(DyngsError) as caught:
        read_colmap(root)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_truncated_binary_file_is_one_line_that_names_it(colmap_root: Path, name: str) -> None:
    """Cut at many lengths; pycolmap alone hangs, aborts or silently reads nonsense at some of them."""
    path = colmap_root / "sparse/0" / f"{name}.bin"
    content = path.read_bytes()
    for length in [*range(0, len(content), max(1, len(content) // 40)), len(content) - 1]:
        path.write_bytes(content[:length])
        assert_refused(colmap_root, path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_truncated_text_file_is_one_line_that_names_it(tmp_path: Path, name: str) -> None:
    """Cut after each line: COLMAP's own header says how many entries there should be."""
    root = write_colmap(tmp_path, "txt")
    path = root / "sparse/0" / f"{name}.txt"
    lines = path.read_text().splitlines(keepends=True)
    entries = [i for i, line in enumerate(lines) if not line.startswith("#")][:: 2 if name == "images" else 1]
    for cut in entries:
        path.write_text("".join(lines[:cut]))
        assert_refused(root, path)
    path.write_text("".join(lines[: entries[-1]]) + lines[entries[-1]][:5])
    assert_refused(root, path)


def test_trailing_bytes_are_refused(colmap_root: Path) -> None:
    with (colmap_root / "sparse/0/points3D.bin").open("ab") as file:
        file.write(b"xyz")
    with pytest.raises(DyngsError, match=r"points3D\.bin: 3 bytes follow"):
        read_colmap(colmap_root)


def test_inconsistent_text_model_is_one_line(tmp_path: Path) -> None:
    root = write_colmap(tmp_path, "txt")
    path = root / "sparse/0/images.txt"
    path.write_text(path.read_text().replace(" 2 left/01.jpg", " 77 left/01.jpg"))
    with pytest.raises(DyngsError, match=r"sparse/0: cannot be read \(.*the COLMAP model is inconsistent"):
        read_colmap(root)


def test_missing_files_of_the_model(colmap_root: Path) -> None:
    (colmap_root / "sparse/0/points3D.bin").unlink()
    with pytest.raises(DyngsError, match=r"points3D\.bin: the COLMAP model lacks this file"):
        read_colmap(colmap_root)


def test_missing_images_folder(colmap_root: Path) -> None:
    shutil.rmtree(colmap_root / "images")
    with pytest.raises(DyngsError, match="images: no such folder"):
        read_colmap(colmap_root)


def test_smaller_images_rescale_other_shapes_are_errors(colmap_root: Path) -> None:
    write_image(colmap_root / "images/left/01.jpg", random_pixels(4, 6, 3))
    capture = read_colmap(colmap_root)
    np.testing.assert_allclose(capture.splits["train"][0].intrinsics, [[5, 0, 3], [0, 5.5, 2], [0, 0, 1]])
    assert any("rescaled" in warning for warning in capture.warnings)
    write_image(colmap_root / "images/left/01.jpg", random_pixels(8, 8, 3))
    with pytest.raises(DyngsError, match=r"left/01\.jpg: the image is 8x8"):
        read_colmap(colmap_root)


def test_cup(shared: Path) -> None:
    """The real model: every point, projected into an image that shows it, is found near its observation."""
    import pycolmap

    capture = read_colmap(shared / "colmap_small")
    assert len(capture.splits["train"]) == 77
    assert capture.points is not None
    assert len(capture.points.xyz) == 9262
    model = pycolmap.Reconstruction(str(shared / "colmap_small/sparse/0"))
    view = next(view for view in capture.splits["train"] if view.name == "10")
    image = next(image for image in model.images.values() if image.name == "10.jpg")
    seen = [point for point in image.points2D if point.has_point3D()]
    xyz = np.array([model.points3D[point.point3D_id].xyz for point in seen])
    on_camera = xyz @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    pixels = on_camera @ view.intrinsics.T
    errors = np.linalg.norm(pixels[:, :2] / pixels[:, 2:] - [point.xy for point in seen], axis=1)
    assert np.median(errors) < 1


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
        with pytest.raises(DyngsError, match=rf"{name}\.bin: the COLMAP file is truncated"):
            read_colmap(colmap_root)


def test_listed_images_are_for_testing(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    images = tmp_path / "images"
    names = sorted(path.relative_to(images).as_posix() for path in images.rglob("*") if path.is_file())
    model = find_model(tmp_path)
    assert model is not None
    (model / "test.txt").write_text(f"{names[1]}\n\nnowhere.png\n")
    capture = read_capture(tmp_path)
    assert [view.image_path for view in capture.splits["test"]] == [images / names[1]]
    assert len(capture.splits["train"]) == len(names) - 1
    assert any("1 listed images have no pose, first nowhere.png" in line for line in capture.warnings)


@pytest.mark.parametrize("factor", [0.0, 0.5, 3.0])
def test_a_quaternion_that_is_no_rotation(tmp_path: Path, factor: float) -> None:
    """COLMAP itself would take zeros for the pose without any rotation."""
    root = write_colmap(tmp_path / "text", "txt")
    path = root / "sparse/0/images.txt"
    rows = [line.split(" ") for line in path.read_text().splitlines()]
    row = next(i for i, words in enumerate(rows) if words[-1] == "right/02.jpg")
    quaternion = [1.0, 0.0, 0.0, 0.0]  # of any length a rotation for COLMAP
    rows[row][1:5] = [str(factor * value) for value in quaternion]
    path.write_text("\n".join(" ".join(words) for words in rows) + "\n")
    for name in ("rigs.txt", "frames.txt"):
        (root / "sparse/0" / name).unlink(missing_ok=True)
    with pytest.raises(DyngsError, match=rf"right/02.jpg: the quaternion of its rotation has length {factor:g}, not 1"):
        read_colmap(root)
