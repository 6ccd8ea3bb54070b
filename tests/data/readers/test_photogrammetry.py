"""Metashape, RealityCapture and ODM: files written by their published definitions, against the
cameras they are of."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from program_captures import (
    HEADER,
    HEIGHT,
    METASHAPE,
    NAMES,
    NEWER_HEADER,
    ODM,
    POINTS,
    POSES,
    REALITY,
    WIDTH,
    cv_from_world,
    write_metashape,
    write_odm,
    write_photos,
    write_reality,
    write_shots,
)
from tiny_captures import edit_json

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, View
from dyngs.data.images.lens import distort
from dyngs.data.readers.photogrammetry import read_metashape, read_odm, read_realitycapture

Project = Callable[[np.ndarray, np.ndarray], tuple[float, float]]


def read(root: Path) -> Capture:
    return read_capture(DataConfig(root=root, test_every=0))


def pixel(view: View, point: np.ndarray) -> np.ndarray:
    """Return the pixel of a world point in a view, with lens distortion."""
    x, y, z = view.cam_from_world[:3, :3] @ point + view.cam_from_world[:3, 3]
    distorted = distort(view.lens, torch.tensor([[x / z, y / z]], dtype=torch.float64))[0].numpy()
    return view.intrinsics[:2, :2] @ distorted + view.intrinsics[:2, 2]


def assert_same_views(
    capture: Capture, project: Project, indices: Sequence[int] = range(4), atol: float = 1e-6
) -> None:
    views = capture.splits["train"]
    assert [view.image_path.name for view in views] == [NAMES[i] for i in indices]
    for i, view in zip(indices, views, strict=True):
        rotation, shift = cv_from_world(POSES[i])
        np.testing.assert_allclose(view.cam_from_world[:3, :3], rotation, atol=1e-8)
        np.testing.assert_allclose(view.cam_from_world[:3, 3], shift, atol=1e-8)
        for point in POINTS:
            np.testing.assert_allclose(
                pixel(view, point), project(rotation @ point + shift, view.image_path), atol=atol
            )


def metashape_frame(
    local: np.ndarray, own: dict[str, float], *, fisheye: bool = False
) -> tuple[float, float]:
    c = dict.fromkeys(("k4", "b2", "p1", "p2", "b1", "k1", "k2", "k3"), 0.0) | own
    x = local[0] / local[2]
    y = local[1] / local[2]
    if fisheye:
        radius = math.hypot(x, y)
        x, y = (q * math.atan(radius) / radius if radius else 0.0 for q in (x, y))
    r2 = x * x + y * y
    radial = 1 + c["k1"] * r2 + c["k2"] * r2**2 + c["k3"] * r2**3 + c["k4"] * r2**4
    u = x * radial + c["p1"] * (r2 + 2 * x * x) + 2 * c["p2"] * x * y
    v = y * radial + c["p2"] * (r2 + 2 * y * y) + 2 * c["p1"] * x * y
    return WIDTH / 2 + c["cx"] + u * c["f"] + u * c["b1"], HEIGHT / 2 + c["cy"] + v * c["f"]


@pytest.mark.parametrize("labels", [NAMES, [name.removesuffix(".jpg") for name in NAMES]])
@pytest.mark.parametrize("placement", [None, "component"])
def test_metashape_has_its_cameras(
    tmp_path: Path, placement: str | None, labels: list[str]
) -> None:
    capture = read(write_metashape(tmp_path, placement=placement, labels=labels))
    assert_same_views(capture, lambda local, _: metashape_frame(local, METASHAPE))
    assert (capture.format, capture.warnings) == ("metashape", ())


@pytest.mark.parametrize("old", [True, False])
def test_a_chunk_is_placed_where_its_component_is_not(tmp_path: Path, old: bool) -> None:
    file = write_metashape(tmp_path, placement="chunk") / "cameras.xml"
    if old:
        file.write_text(
            file.read_text().replace('<components><component id="5"></component></components>', "")
        )
    assert_same_views(read(tmp_path), lambda local, _: metashape_frame(local, METASHAPE))


def test_fisheye_lenses_of_metashape(tmp_path: Path) -> None:
    lens = {"f": 30.0, "cx": 1.0, "cy": 2.0, "k1": 0.02, "k2": -0.01, "k3": 0.003, "k4": -0.001}
    capture = read(write_metashape(tmp_path, lens, "fisheye"))
    assert_same_views(capture, lambda local, _: metashape_frame(local, lens, fisheye=True))


def test_k4_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        DyngsError, match=r"sensor X-T4: its distortion with k4=-9 is not supported"
    ):
        read(write_metashape(tmp_path, METASHAPE | {"k4": -9.0}))


def test_photos_that_metashape_did_not_align_are_left_out(tmp_path: Path) -> None:
    root = write_metashape(tmp_path, unaligned=[1])
    (root / "images" / NAMES[3]).unlink()
    capture = read(root)
    assert_same_views(capture, lambda local, _: metashape_frame(local, METASHAPE), indices=[0, 2])
    said = (
        "cameras.xml: 2 of 4 cameras have no pose or no photo and are skipped: DSC_1.jpg, DSC_3.jpg"
    )
    assert capture.warnings == (said,)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'type="frame"',
            'type="spherical"',
            r"sensor X-T4: is of type spherical .*; only calibrated frame and fisheye",
        ),
        ('type="frame"', 'type="equisolid_fisheye"', "is of type equisolid_fisheye"),
        ("<f>40.0</f>", "<f>forty</f>", r"cameras\.xml: cannot be read .*forty"),
        ("</document>", "", r"cameras\.xml: cannot be read"),
        (
            "<document",
            '<!DOCTYPE d [<!ENTITY a "aaaa">]><document',
            r"cameras\.xml: XML entities are not allowed",
        ),
        (' label="DSC_1.jpg"', ' label="DSC_0.jpg"', "DSC_0.jpg is listed more than once"),
        ('sensor_id="7"', 'sensor_id="8"', r"cameras\.xml: cannot be read .*'8'"),
        ("DSC_", "IMG_", "no photo in .* is named after a posed camera"),
    ],
)
def test_damaged_cameras_of_metashape_are_one_line(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    file = write_metashape(tmp_path) / "cameras.xml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(DyngsError, match=message):
        read_metashape(tmp_path)


def reality_pixel(local: np.ndarray, _: Path) -> tuple[float, float]:
    x = local[0] / local[2]
    y = local[1] / local[2]
    r2 = x * x + y * y
    radial = 1 + REALITY["k1"] * r2 + REALITY["k2"] * r2**2 + REALITY["k3"] * r2**3
    t1 = REALITY["t1"]
    t2 = REALITY["t2"]
    u = x * radial + t1 * (r2 + 2 * x * x) + 2 * t2 * x * y
    v = y * radial + t2 * (r2 + 2 * y * y) + 2 * t1 * x * y
    side = max(WIDTH, HEIGHT)
    scale = REALITY["f"] / 36 * side
    return WIDTH / 2 + REALITY["px"] * side + u * scale, HEIGHT / 2 + REALITY[
        "py"
    ] * side + v * scale


@pytest.mark.parametrize("folder", ["images", ".", "day 1/left"])
@pytest.mark.parametrize("header", [HEADER, NEWER_HEADER, "#cameras 4\n" + HEADER])
def test_reality_capture_has_its_cameras(tmp_path: Path, header: str, folder: str) -> None:
    capture = read(write_reality(tmp_path, header, folder))
    assert_same_views(capture, reality_pixel)
    assert (capture.format, capture.warnings) == ("realitycapture", ())


@pytest.mark.parametrize(
    ("heading", "pitch", "forward", "up"),
    [
        (0, 0, (0, 0, -1), (0, 1, 0)),
        (90, 0, (0, 0, -1), (1, 0, 0)),
        (0, 90, (0, 1, 0), (0, 0, 1)),
        (90, 90, (1, 0, 0), (0, 0, 1)),
    ],
)
def test_headings_are_clockwise_from_north(
    tmp_path: Path, heading: float, pitch: float, forward: Sequence[float], up: Sequence[float]
) -> None:
    write_photos(tmp_path, NAMES[:1])
    (tmp_path / "a.csv").write_text(
        f"#name,x,y,alt,heading,pitch,roll,f\n{NAMES[0]},1,2,3,{heading},{pitch},0,36\n"
    )
    view = read(tmp_path).splits["train"][0]
    np.testing.assert_allclose(view.cam_from_world[2, :3], forward, atol=1e-12)
    np.testing.assert_allclose(-view.cam_from_world[1, :3], up, atol=1e-12)
    np.testing.assert_allclose(
        view.intrinsics, [[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1]]
    )


def test_portrait_photos_are_measured_by_their_longer_side(tmp_path: Path) -> None:
    write_photos(tmp_path, NAMES[:1], (HEIGHT, WIDTH))
    (tmp_path / "a.csv").write_text(
        f"#name,x,y,alt,heading,pitch,roll,f,px,py\n{NAMES[0]},1,2,3,0,0,0,18,.1,.2\n"
    )
    view = read(tmp_path).splits["train"][0]
    expected = [[24, 0, 18 + 4.8], [0, 24, 24 + 9.6], [0, 0, 1]]
    np.testing.assert_allclose(view.intrinsics, expected)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("DSC_1.jpg,", "DSC_1.jpg,x", r"registration\.csv: cannot be read .*x"),
        ("DSC_1.jpg,", "DSC_1.jpg,nan", r"DSC_1\.jpg: the pose|cannot be read"),
        (",30.0,", ",-30.0,", "focal length|must be positive"),
        ("DSC_1.jpg", "DSC_0.jpg", "more than once"),
    ],
)
def test_damaged_files_of_reality_capture_are_one_line(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    file = write_reality(tmp_path) / "registration.csv"
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(DyngsError, match=message):
        read_realitycapture(tmp_path)


def test_two_files_of_cameras_are_refused(tmp_path: Path) -> None:
    content = (write_reality(tmp_path) / "registration.csv").read_bytes()
    (tmp_path / "second.csv").write_bytes(content)
    with pytest.raises(DyngsError, match=r"registration\.csv and second\.csv both contain cameras"):
        read(tmp_path)
    (tmp_path / "second.csv").write_text("name,count\na,1\n")
    assert len(read(tmp_path).splits["train"]) == 4


def odm_pixel(local: np.ndarray, _: Path) -> tuple[float, float]:
    c = {key: value for key, value in ODM.items() if key != "projection_type"}
    x = local[0] / local[2]
    y = local[1] / local[2]
    r2 = x * x + y * y
    radial = 1 + r2 * (c["k1"] + r2 * (c["k2"] + r2 * c["k3"]))
    u = x * radial + 2 * c["p1"] * x * y + c["p2"] * (r2 + 2 * x * x)
    v = y * radial + 2 * c["p2"] * x * y + c["p1"] * (r2 + 2 * y * y)
    # Normalised coordinates: the middle of the image is zero, its longer side has length one.
    return (c["focal_x"] * u + c["c_x"]) * WIDTH + WIDTH / 2, (
        c["focal_y"] * v + c["c_y"]
    ) * WIDTH + HEIGHT / 2


def test_odm_has_its_cameras_and_points(tmp_path: Path) -> None:
    capture = read(write_odm(tmp_path))
    assert_same_views(capture, odm_pixel)
    assert capture.format == "odm"
    assert capture.warnings == ("reconstruction.json: using the largest of 2 models (4 photos)",)
    assert capture.points is not None
    np.testing.assert_allclose(capture.points.xyz, POINTS, atol=1e-12)
    np.testing.assert_array_equal(capture.points.rgb, [[i, 100, 200] for i in range(4)])


def test_a_project_of_opensfm_is_read(tmp_path: Path) -> None:
    (write_odm(tmp_path) / "opensfm" / "reconstruction.json").rename(
        tmp_path / "reconstruction.json"
    )
    assert_same_views(read(tmp_path), odm_pixel)


def test_odm_without_a_reconstruction(tmp_path: Path) -> None:
    root = write_shots(tmp_path)
    assert_same_views(read(root), odm_pixel)
    edit_json(root / "cameras.json", lambda content: content.update(second=ODM))
    with pytest.raises(DyngsError, match=r"DSC_0\.jpg: which of 2 cameras took this photo"):
        read(root)


@pytest.mark.parametrize(("kind", "model"), [("perspective", "opencv"), ("fisheye", "fisheye")])
def test_one_focal_length_of_odm_is_for_both_axes(tmp_path: Path, kind: str, model: str) -> None:
    lens = {
        "projection_type": kind,
        "width": WIDTH,
        "height": HEIGHT,
        "focal": 0.75,
        "k1": 0.1,
        "k2": -0.05,
    }
    view = read(write_odm(tmp_path, lens)).splits["train"][0]  # type: ignore[arg-type]
    np.testing.assert_allclose(view.intrinsics, [[36, 0, 24], [0, 36, 18], [0, 0, 1]])
    assert (view.lens.model, view.lens.params) == (model, (0.1, -0.05, 0.0, 0.0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"projection_type": "spherical"},
            r"DSC_0\.jpg: projection 'spherical' is not supported, only perspective",
        ),
        ({"focal_x": None}, r"reconstruction\.json: cannot be read"),
        ({"focal_x": "1"}, r"cannot be read|finite number"),
        ({"width": 0, "height": 0}, "w and h must be|cannot be read"),
    ],
)
def test_damaged_cameras_of_odm_are_one_line(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    with pytest.raises(DyngsError, match=message):
        read_odm(write_odm(tmp_path, ODM | change))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "content", ["", "[]", "{}", "[{}]", '[{"shots": 1}]', '[{"shots": {"a": {}}, "cameras": {}}]']
)
def test_damaged_reconstructions_are_one_line(tmp_path: Path, content: str) -> None:
    (write_odm(tmp_path) / "opensfm" / "reconstruction.json").write_text(content)
    with pytest.raises(DyngsError, match=r"reconstruction\.json: cannot be read"):
        read_odm(tmp_path)
