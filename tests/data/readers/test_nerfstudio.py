from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_captures import edit_json

from dyngs.data.capture import Lens
from dyngs.data.readers.nerfstudio import read_nerfstudio
from dyngs.errors import DyngsError


def names(views: tuple) -> list[str]:
    return [view.name for view in views]


def test_intrinsics_and_distortion_of_the_file(nerfstudio_root: Path) -> None:
    view = read_nerfstudio(nerfstudio_root).splits["train"][0]
    np.testing.assert_array_equal(view.intrinsics, [[10, 0, 6.5], [0, 11, 3.5], [0, 0, 1]])
    assert view.lens == Lens("opencv", (0.1, 0.0, 0.0, -0.01))
    assert view.name == "images/00"


def test_intrinsics_and_distortion_of_a_frame(nerfstudio_root: Path) -> None:
    own = {"fl_x": 20.0, "fl_y": 20.0, "cx": 6.0, "cy": 4.0, "k1": 0.0, "k3": 0.5}
    edit_json(nerfstudio_root / "transforms.json", lambda c: c["frames"][4].update(own))
    view = read_nerfstudio(nerfstudio_root).splits["train"][4]
    np.testing.assert_array_equal(view.intrinsics, [[20, 0, 6], [0, 20, 4], [0, 0, 1]])
    assert view.lens == Lens("opencv", (0.0, 0.0, 0.0, -0.01, 0.5))


@pytest.mark.parametrize(
    ("fields", "lens"),
    [
        ({"camera_model": "PINHOLE"}, Lens()),
        ({"camera_model": "OPENCV_FISHEYE", "k4": 0.2}, Lens("fisheye", (0.1, 0.0, 0.0, 0.2))),
        ({"camera_model": None, "is_fisheye": True}, Lens("fisheye", (0.1, 0.0, 0.0, 0.0))),
        ({"camera_model": None}, Lens("opencv", (0.1, 0.0, 0.0, -0.01))),
        ({"k1": 0, "p2": 0}, Lens()),
        ({"camera_model": "FULL_OPENCV", "k4": 0.2}, Lens("opencv", (0.1, 0.0, 0.0, -0.01, 0.0, 0.2))),
    ],
)
def test_camera_models(nerfstudio_root: Path, fields: dict, lens: Lens) -> None:
    edit_json(nerfstudio_root / "transforms.json", lambda c: c.update(fields))
    assert read_nerfstudio(nerfstudio_root).splits["train"][0].lens == lens


@pytest.mark.parametrize(("fields", "word"), [({"camera_model": "EQUIRECTANGULAR"}, "EQUI"), ({"k4": 0.1}, "k4")])
def test_models_that_we_cannot_undo_are_refused(nerfstudio_root: Path, fields: dict, word: str) -> None:
    edit_json(nerfstudio_root / "transforms.json", lambda c: c.update(fields))
    with pytest.raises(DyngsError, match=word):
        read_nerfstudio(nerfstudio_root)


def test_split_lists(nerfstudio_root: Path) -> None:
    lists = {
        "train_filenames": ["images/00.jpg", "images/02.jpg"],
        "val_filenames": ["images/01.jpg"],
        "test_filenames": ["images/05.jpg", "images/99.jpg"],
    }
    edit_json(nerfstudio_root / "transforms.json", lambda c: c.update(lists))
    capture = read_nerfstudio(nerfstudio_root)
    assert names(capture.splits["train"]) == ["images/00", "images/02"]
    assert names(capture.splits["val"]) == ["images/01"]
    assert names(capture.splits["test"]) == ["images/05"]
    assert any("images/99.jpg" in warning for warning in capture.warnings)
    assert any("6 frames are in no split" in warning for warning in capture.warnings)


def test_val_list_alone_is_what_is_held_out(nerfstudio_root: Path) -> None:
    edit_json(nerfstudio_root / "transforms.json", lambda c: c.update(val_filenames=["images/01.jpg"]))
    splits = read_nerfstudio(nerfstudio_root).splits
    assert names(splits["test"]) == ["images/01"]
    assert len(splits["train"]) == 9
    assert "val" not in splits


def test_masks_and_windows_separators(nerfstudio_root: Path) -> None:
    change = {"file_path": "images\\03.jpg", "mask_path": "masks/03.png"}
    edit_json(nerfstudio_root / "transforms.json", lambda c: c["frames"][3].update(change))
    view = read_nerfstudio(nerfstudio_root).splits["train"][3]
    assert view.name == "images/03"
    assert view.mask_path == nerfstudio_root / "masks/03.png"


@pytest.mark.parametrize("width", [24, 6])
def test_resized_images_rescale_the_intrinsics(nerfstudio_root: Path, width: int) -> None:
    """The JSON speaks of images of another size but the same shape."""
    scale = 12 / width
    edit_json(nerfstudio_root / "transforms.json", lambda c: c.update(w=width, h=width * 8 / 12))
    capture = read_nerfstudio(nerfstudio_root)
    view = capture.splits["train"][0]
    wanted = [[10 * scale, 0, 6.5 * scale], [0, 11 * scale, 3.5 * scale], [0, 0, 1]]
    np.testing.assert_allclose(view.intrinsics, wanted, rtol=1e-12)
    assert (view.width, view.height) == (12, 8)
    assert any("rescaled" in warning for warning in capture.warnings)


def test_another_shape_is_an_error(nerfstudio_root: Path) -> None:
    edit_json(nerfstudio_root / "transforms.json", lambda c: c.update(w=8, h=12))
    with pytest.raises(DyngsError, match=r"12x8 but its intrinsics are for 8x12 \(turned"):
        read_nerfstudio(nerfstudio_root)


def test_points_of_a_ply_in_double(nerfstudio_root: Path) -> None:
    """Georeferenced points keep their millimetres; colours come along."""
    header = ["ply", "format ascii 1.0", "element vertex 2", *[f"property double {axis}" for axis in "xyz"]]
    header += [*[f"property uchar {channel}" for channel in ("red", "green", "blue")], "end_header"]
    rows = ["4567890.123 1.5 -2 255 0 7", "4567890.124 0 0 1 2 3"]
    (nerfstudio_root / "points.ply").write_text("\n".join(header + rows) + "\n")
    edit_json(nerfstudio_root / "transforms.json", lambda c: c.update(ply_file_path="points.ply"))
    points = read_nerfstudio(nerfstudio_root).points
    assert points is not None
    np.testing.assert_allclose(points.xyz[:, 0], [4567890.123, 4567890.124], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(points.rgb, [[255, 0, 7], [1, 2, 3]])


def test_fox(shared: Path) -> None:
    capture = read_nerfstudio(shared / "fox")
    views = capture.splits["train"]
    assert len(views) == 50
    assert views[0].lens == Lens("opencv", (0.0578421, -0.0805099, -0.000980296, 0.00015575))
    assert views[0].intrinsics[0, 0] == 343.88
