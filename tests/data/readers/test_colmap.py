from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from tiny_captures import opengl_pose, random_pixels, write_colmap, write_image

from dyngs.api.load import read_capture
from dyngs.core.errors import DyngsError
from dyngs.data.images.lens import distort
from dyngs.data.readers.colmap import (
    ModelCamera,
    is_colmap,
    model_folders,
    pinhole_and_lens,
    read_colmap,
)

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
        camera_id=1,
        model=getattr(pycolmap.CameraModelId, model),
        width=12,
        height=8,
        params=list(MODELS[model]),
    )
    intrinsics, lens = pinhole_and_lens(ModelCamera(model, (12, 8), MODELS[model]), "here")
    rays = np.random.default_rng(1).uniform(-0.6, 0.6, (50, 2))
    rays[0] = 0
    wanted = camera.img_from_cam(np.column_stack([rays, np.ones(50)]))
    found = distort(lens, torch.from_numpy(rays)).numpy() @ intrinsics[:2, :2] + intrinsics[:2, 2]
    np.testing.assert_allclose(found, wanted, atol=1e-9)


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


@pytest.mark.parametrize(
    "name",
    ["right/00.jpg.png", "right/00.png", "right/00.jpg", "right/00.mask.png", "Right/00.JPG.png"],
)
def test_masks_are_found_by_any_usual_name(colmap_root: Path, name: str) -> None:
    write_image(colmap_root / "masks" / name, random_pixels(8, 12, 1))
    capture = read_colmap(colmap_root)
    found = {view.name: view.mask_path for view in capture.splits["train"]}
    assert found.pop("right/00") == colmap_root / "masks" / name
    assert set(found.values()) == {None}
    assert any("8 images have no mask" in warning for warning in capture.warnings)


def numbered_models(root: Path, *counts: int) -> None:
    """Write the text sub-models 0, 1, ... with the given numbers of images each."""
    folder = root / "sparse/0"
    lines = [line for line in (folder / "images.txt").read_text().splitlines() if line[:1] != "#"]
    for number, count in enumerate(counts):
        part = root / "sparse" / str(number)
        part.mkdir(exist_ok=True)
        for name in ("cameras.txt", "points3D.txt"):
            (part / name).write_bytes((folder / name).read_bytes())
        (part / "images.txt").write_text("\n".join(lines[: 2 * count]) + "\n")


@pytest.mark.parametrize(("counts", "read"), [((2, 6, 3), 1), ((6, 2), 0), ((2, 2), 0)])
def test_largest_of_several_models_is_read(
    tmp_path: Path, counts: tuple[int, ...], read: int
) -> None:
    root = write_colmap(tmp_path, "txt")
    numbered_models(root, *counts)
    capture = read_colmap(root)
    assert len(capture.splits["train"]) == max(counts)
    (line,) = (line for line in capture.warnings if "separate models" in line)
    assert f"{len(counts)} separate models found; using the largest, {read} " in line


@pytest.mark.parametrize(
    "folder", ["colmap/sparse/0", "colmap/sparse", "colmap", "distorted/sparse/0", "sparse/3"]
)
def test_model_in_the_folders_of_other_programs(colmap_root: Path, folder: str) -> None:
    (colmap_root / folder).parent.mkdir(parents=True, exist_ok=True)
    (colmap_root / "sparse/0").rename(colmap_root / folder)
    assert len(read_capture(colmap_root).splits["train"]) == 7
    if folder.startswith("distorted"):  # as 3DGS converts photos: these are in "input"
        (colmap_root / "images").rename(colmap_root / "input")
        (colmap_root / "images").mkdir()
        assert len(read_capture(colmap_root).splits["train"]) == 7


def test_the_model_that_nerfstudio_keeps_is_no_second_capture(nerfstudio_root: Path) -> None:
    write_colmap(nerfstudio_root / "colmap")
    capture = read_capture(nerfstudio_root)
    assert (capture.format, capture.warnings) == ("nerfstudio", ())


def renamed(root: Path, change: Callable[[str], str]) -> None:
    """Change the names of images in a text model."""
    path = root / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    for row, line in enumerate(lines):
        if line.endswith(".jpg"):
            head, _, name = line.rpartition(" ")
            lines[row] = f"{head} {change(name)}"
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    "change",
    [
        lambda name: name.replace("/", "\\"),
        lambda name: "D:\\scans\\house\\images\\" + name.replace("/", "\\"),
        lambda name: "/scans/house/" + name,
        lambda name: name.replace(".jpg", ".JPG").replace("left", "Left"),
    ],
    ids=["backslashes", "windows", "absolute", "case"],
)
def test_names_as_other_programs_write_them(tmp_path: Path, change: Callable[[str], str]) -> None:
    root = write_colmap(tmp_path, "txt")
    expected = read_colmap(root)
    write_image(root / "masks/left/01.jpg.png", random_pixels(8, 12, 1))
    renamed(root, change)
    capture = read_colmap(root)
    assert {view.image_path for view in capture.splits["train"]} == {
        view.image_path for view in expected.splits["train"]
    }
    assert [view.name for view in capture.splits["train"] if view.mask_path] == ["left/01"]


def test_images_that_are_listed_twice(tmp_path: Path) -> None:
    root = write_colmap(tmp_path, "txt")
    renamed(root, lambda name: "left/01.jpg" if name == "left/03.jpg" else name)
    with pytest.raises(DyngsError, match=r"left/01\.jpg is listed more than once"):
        read_colmap(root)


def test_missing_images_folder(colmap_root: Path) -> None:
    shutil.rmtree(colmap_root / "images")
    with pytest.raises(DyngsError, match="images: no such folder"):
        read_colmap(colmap_root)


def test_smaller_images_rescale_other_shapes_are_errors(colmap_root: Path) -> None:
    write_image(colmap_root / "images/left/01.jpg", random_pixels(4, 6, 3))
    capture = read_colmap(colmap_root)
    np.testing.assert_allclose(
        capture.splits["train"][0].intrinsics, [[5, 0, 3], [0, 5.5, 2], [0, 0, 1]]
    )
    assert any("rescaled" in warning for warning in capture.warnings)
    write_image(colmap_root / "images/left/01.jpg", random_pixels(8, 8, 3))
    with pytest.raises(DyngsError, match=r"left/01\.jpg: the image is 8x8"):
        read_colmap(colmap_root)


def test_cup(shared: Path) -> None:
    """The real model: every point, projected into an image that shows it, is found near its
    observation."""
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


def test_listed_images_are_for_testing(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    images = tmp_path / "images"
    names = sorted(
        path.relative_to(images).as_posix() for path in images.rglob("*") if path.is_file()
    )
    (model,) = model_folders(tmp_path)
    (model / "test.txt").write_text(f"{names[1]}\n\nnowhere.png\n")
    capture = read_capture(tmp_path)
    assert [view.image_path for view in capture.splits["test"]] == [images / names[1]]
    assert len(capture.splits["train"]) == len(names) - 1
    assert any(
        "1 listed images have no pose, first nowhere.png" in line for line in capture.warnings
    )


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
    with pytest.raises(
        DyngsError,
        match=rf"right/02.jpg: its rotation quaternion has length {factor:g} instead of 1",
    ):
        read_colmap(root)


def test_images_without_points_are_reported(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path) / "sparse" / "0"
    assert not read_capture(tmp_path).warnings
    model = pycolmap.Reconstruction(str(folder))
    for index in range(5):
        model.delete_observation(3, index)
    model.write_binary(str(folder))
    (line,) = read_capture(tmp_path).warnings
    assert line.startswith(f"1 image of the model, first {model.images[3].name}, observe")
