"""Readers for exported cameras: Metashape, RealityCapture (RealityScan), ODM, Polycam and
Record3D."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
from typing import Any
from xml.etree import ElementTree

import numpy as np

from dyngs.core.errors import DyngsError, format_count, wrap_read_errors
from dyngs.data.capture import Capture, CaptureFormat, PointCloud
from dyngs.data.geometry import OPENGL_FROM_OPENCV, to_opengl_pose
from dyngs.data.images.images import SUFFIXES, list_files, read_header
from dyngs.data.readers.transforms import FrameEntry, FrameFile, training_capture
from dyngs.io.containment import check_inside
from dyngs.io.fields import first_few, parse_numbers, read_json_object, require_key

_HEAD_BYTES = 4096
_ADVICE = "export it again"
_Fields = dict[str, Any]
"""Fields of a frame in a transforms file."""


def _photos_of(root: Path) -> dict[str, Path]:
    """Return the photos of a capture by name and by stem: those in ``images``, else below the
    root."""
    folder = root / "images" if (root / "images").is_dir() else root
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*"), key=lambda path: len(path.parts)):
        if path.suffix.lower() in SUFFIXES:
            found.setdefault(path.name, path)
            found.setdefault(path.stem, path)
    return found


def _find(photos: dict[str, Path], name: str) -> Path | None:
    """Return the photo of this name, with or without folder and suffix."""
    path = PureWindowsPath(name)
    return photos.get(path.name, photos.get(path.stem))


def _capture(
    root: Path,
    format: str,
    path: Path,
    photos: dict[str, Path],
    cameras: Sequence[tuple[str, _Fields]],
) -> Capture:
    """Return a capture of (photo name, fields); fields without a pose are skipped, with a
    warning."""
    frames: list[FrameEntry] = []
    left_out: list[str] = []
    for name, fields in cameras:
        image = _find(photos, name)
        if image is None or "transform_matrix" not in fields:
            left_out.append(name)
        else:
            frames.append(
                FrameEntry(f"{path}, {name}", {**fields, "file_path": str(image)}, image=image)
            )
    if not frames:
        raise DyngsError(
            f"{path}: no photo in {root} is named after a posed camera; copy the photos there"
        )
    count = f"{len(left_out)} of {format_count(len(cameras), 'camera')}"
    line = f"{path.name}: {count} have no pose or no photo and are skipped: {first_few(left_out)}"
    return training_capture(
        root, format, FrameFile(root / path.name, frames), *([line] if left_out else [])
    )


def _exports(root: Path, suffix: str, mark: bytes) -> list[Path]:
    """Return the files that contain ``mark`` near their beginning."""
    found: list[Path] = []
    for path in list_files(root, (suffix,)):
        with path.open("rb") as file:
            if mark in file.read(_HEAD_BYTES):
                found.append(path)
    return found


def _only(files: Sequence[Path]) -> Path:
    if len(files) > 1:
        raise DyngsError(f"{files[0]} and {files[1].name} both contain cameras; move one elsewhere")
    return check_inside(files[0])


def _radial(coefficients: Sequence[float]) -> _Fields:
    return {f"k{i}": k for i, k in enumerate(coefficients, start=1)}


def _brown(where: str, k: Sequence[float]) -> _Fields:
    """Return the radial distortion 1 + k1 r^2 + .. + k3 r^6 for OpenCV, which has no r^8 term."""
    if k[3] != 0:
        raise DyngsError(
            f"{where}: its distortion with k4={k[3]:g} is not supported; export undistorted photos"
        )
    return _radial(k[:3])


def read_metashape(root: Path) -> Capture:
    """Read cameras exported from Metashape as .xml, and the photos in the folder.

    ``transform`` of a camera maps OpenCV axes to the chunk; that of its component, or of the
    chunk, maps to the world.
    """
    path = _only(_exports(root, ".xml", b"<chunk"))
    cameras: list[tuple[str, _Fields]] = []
    with wrap_read_errors(path, _ADVICE):
        content = path.read_bytes()
        if b"<!ENTITY" in content:
            raise DyngsError(f"{path}: XML entities are not allowed; {_ADVICE}")
        chunk = next(ElementTree.fromstring(content).iter("chunk"))
        sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
        placements: dict[str | None, ElementTree.Element | None] = {}
        for component in chunk.iterfind("components/component"):
            placements[component.get("id")] = component.find("transform")
        for camera in chunk.iterfind("cameras//camera"):
            fields: _Fields = {}
            pose = camera.findtext("transform")
            if pose is not None:
                fields = _metashape_lens(path, sensors[camera.get("sensor_id")])
                placement = placements.get(camera.get("component_id"))
                if placement is None:
                    placement = chunk.find("transform")
                placed = _placed(placement, np.array(pose.split(), np.float64).reshape(4, 4))
                fields["transform_matrix"] = (placed @ OPENGL_FROM_OPENCV).tolist()
            cameras.append((camera.attrib["label"], fields))
    return _capture(root, "metashape", path, _photos_of(root), cameras)


def _placed(transform: ElementTree.Element | None, pose: np.ndarray) -> np.ndarray:
    """Return a pose in the world, given the ``transform`` (rotation, scale, translation) of its
    chunk."""
    if transform is None:
        return pose
    rotation = np.array(
        transform.findtext("rotation", "1 0 0 0 1 0 0 0 1").split(), np.float64
    ).reshape(3, 3)
    shift = np.array(transform.findtext("translation", "0 0 0").split(), np.float64)
    placed = np.eye(4)
    placed[:3, :3] = rotation @ pose[:3, :3]
    placed[:3, 3] = float(transform.findtext("scale", "1")) * rotation @ pose[:3, 3] + shift
    return placed


def _metashape_lens(path: Path, sensor: ElementTree.Element) -> _Fields:
    """Return the intrinsics of a sensor in px. Its cx, cy are offsets from the centre; its p1, p2
    are OpenCV's p2, p1."""
    where = f"{path}, sensor {sensor.get('label')}"
    calibrations = sensor.findall("calibration")
    kind = sensor.get("type")
    if kind not in ("frame", "fisheye") or not calibrations:
        raise DyngsError(
            f"{where}: is of type {kind} with {format_count(len(calibrations), 'calibration')}; only "
            "calibrated frame and fisheye sensors are read: convert its photos to those of a "
            "frame camera in Metashape"
        )
    adjusted = [
        calibration for calibration in calibrations if calibration.get("class") == "adjusted"
    ]
    values = {child.tag: child.text for child in (adjusted or calibrations)[0]}
    f, cx, cy, p1, p2, b1, *k = (
        float(values.get(key) or 0)
        for key in ("f", "cx", "cy", "p1", "p2", "b1", "k1", "k2", "k3", "k4")
    )
    size = next(sensor.iter("resolution"))
    width = int(size.attrib["width"])
    height = int(size.attrib["height"])
    own = {
        "w": width,
        "h": height,
        "fl_x": f + b1,
        "fl_y": f,
        "cx": width / 2 + cx,
        "cy": height / 2 + cy,
    }
    if kind == "fisheye":
        return {**own, **_radial(k), "camera_model": "OPENCV_FISHEYE"}
    return {**own, **_brown(where, k), "p1": p2, "p2": p1}


METASHAPE_FORMAT = CaptureFormat(
    "metashape",
    "cameras of Metashape as .xml",
    lambda root: bool(_exports(root, ".xml", b"<chunk")),
    read_metashape,
)


_REALITYCAPTURE_MARK = b"#name,x,y,alt,"
_RENAMED = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}
"""Columns of RealityScan 2, and their names in RealityCapture."""


def read_realitycapture(root: Path) -> Capture:
    """Read RealityCapture's .csv of "internal/external camera parameters", and the photos in the
    folder.

    x points east, y north. Heading is clockwise from north, pitch up from straight down, in
    degrees. ``f`` is for 36 mm wide film; ``px`` and ``py`` are offsets from the centre in longer
    sides. ``t1`` and ``t2`` are OpenCV's p2 and p1.
    """
    path = _only(_exports(root, ".csv", _REALITYCAPTURE_MARK))
    photos = _photos_of(root)
    cameras: list[tuple[str, _Fields]] = []
    with wrap_read_errors(path, _ADVICE), path.open(encoding="utf-8-sig", newline="") as file:
        titles = next(line for line in file if line.startswith("#name")).strip().split(",")
        for row in csv.DictReader(file, [_RENAMED.get(title, title) for title in titles]):
            name = row.pop("#name")
            image = _find(photos, name)
            fields: _Fields = {}
            if image is not None:
                width, height = read_header(image).size
                values = {key: float(text) for key, text in row.items() if text}
                fields = _realitycapture_camera(f"{path}, {name}", values, width, height)
            cameras.append((name, fields))
    return _capture(root, "realitycapture", path, photos, cameras)


def _realitycapture_camera(
    where: str, values: dict[str, float], width: int, height: int
) -> _Fields:
    from scipy.spatial.transform import Rotation  # late: other captures do not need it

    px, py, t1, t2, *k = (
        values.get(key, 0.0) for key in ("px", "py", "t1", "t2", "k1", "k2", "k3", "k4")
    )
    side = max(width, height)
    focal = values["f"] / 36 * side
    pose = np.eye(4)
    angles = (-values["heading"], values["pitch"], values["roll"])
    pose[:3, :3] = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
    pose[:3, 3] = (values["x"], values["y"], values["alt"])
    own = {
        "w": width,
        "h": height,
        "fl_x": focal,
        "cx": width / 2 + px * side,
        "cy": height / 2 + py * side,
    }
    lens = _brown(where, k)
    return {**own, **lens, "p1": t2, "p2": t1, "transform_matrix": pose.tolist()}


REALITYCAPTURE_FORMAT = CaptureFormat(
    "realitycapture",
    "internal/external camera parameters of RealityCapture as .csv",
    lambda root: bool(_exports(root, ".csv", _REALITYCAPTURE_MARK)),
    read_realitycapture,
)


_ODM_FILES = ("opensfm/reconstruction.json", "reconstruction.json", "odm_report/shots.geojson")
_ODM_LENSES = {
    "perspective": "OPENCV",
    "brown": "OPENCV",
    "fisheye": "OPENCV_FISHEYE",
    "fisheye_opencv": "OPENCV_FISHEYE",
}
"""Projection types of OpenSfM, and camera models of transforms files."""


def read_odm(root: Path) -> Capture:
    """Read ``reconstruction.json`` of ODM or OpenSfM, else ``odm_report/shots.geojson`` and
    ``cameras.json``.

    Rotations are axis-angle, from the world to OpenCV axes. In ``shots.geojson`` the translation
    is the camera position.
    """
    path = next(root / name for name in _ODM_FILES if (root / name).is_file())
    points = None
    warnings: list[str] = []
    with wrap_read_errors(path, _ADVICE):
        content = json.loads(check_inside(path).read_text(encoding="utf-8-sig"))
        if path.suffix == ".json":
            model = max(content, key=lambda model: len(model["shots"]))
            if len(content) > 1:
                warnings = [
                    f"{path.name}: using the largest of {len(content)} models "
                    f"({len(model['shots'])} photos)"
                ]
            lenses = model["cameras"]
            shots = model["shots"]
            listed = [
                [*point["coordinates"], *point["color"]]
                for point in model.get("points", {}).values()
            ]
            if listed:
                table = parse_numbers(f"{path}: points", listed, (len(listed), 6))
                points = PointCloud(table[:, :3], table[:, 3:].clip(0, 255).astype(np.uint8))
        else:
            lenses = json.loads(check_inside(root / "cameras.json").read_text(encoding="utf-8-sig"))
            shots = {
                feature["properties"]["filename"]: feature["properties"]
                for feature in content["features"]
            }
        cameras = [(name, _odm_camera(path, name, shot, lenses)) for name, shot in shots.items()]
    capture = _capture(root, "odm", path, _photos_of(root), cameras)
    return capture.replace(points=points or capture.points, warnings=(*warnings, *capture.warnings))


def _odm_camera(path: Path, name: str, shot: _Fields, lenses: dict[str, _Fields]) -> _Fields:
    from scipy.spatial.transform import Rotation  # late: other captures do not need it

    where = f"{path}, {name}"
    if "camera" not in shot and len(lenses) > 1:
        raise DyngsError(
            f"{where}: which of {len(lenses)} cameras took this photo is not recorded; add "
            f"{_ODM_FILES[0]}"
        )
    lens = lenses[shot.get("camera", next(iter(lenses)))]
    kind = lens["projection_type"]
    if kind not in _ODM_LENSES:
        raise DyngsError(
            f"{where}: projection {kind!r:.40} is not supported, only {', '.join(_ODM_LENSES)}"
        )
    width = lens["width"]
    height = lens["height"]
    side = max(width, height)
    fx, fy = (side * lens.get(key, lens.get("focal")) for key in ("focal_x", "focal_y"))
    cx = width / 2 + side * lens.get("c_x", 0)
    cy = height / 2 + side * lens.get("c_y", 0)
    own = {
        "w": width,
        "h": height,
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
        "camera_model": _ODM_LENSES[kind],
    }
    distortion = {key: lens[key] for key in ("k1", "k2", "k3", "k4", "p1", "p2") if key in lens}
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(shot["rotation"]).as_matrix()
    pose[:3, 3] = shot["translation"]
    if path.suffix == ".geojson":
        pose[:3, 3] = -pose[:3, :3] @ pose[:3, 3]
    return {**own, **distortion, "transform_matrix": to_opengl_pose(pose).tolist()}


ODM_FORMAT = CaptureFormat(
    "odm",
    " or ".join(_ODM_FILES),
    lambda root: any((root / name).is_file() for name in _ODM_FILES),
    read_odm,
    extends="camera_folders",  # which has a cameras.json, too
)


_POLYCAM = (
    ("keyframes/corrected_images", "keyframes/corrected_cameras"),
    ("keyframes/images", "keyframes/cameras"),
)
_RECORD3D = (
    ("EXR_RGBD/rgb", "EXR_RGBD/metadata.json"),
    ("rgb", "metadata.json"),
    ("rgbd", "metadata"),  # of an unpacked .r3d
)
_INTRINSICS = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "w": "width", "h": "height"}
"""Keys of transforms files, and those of Polycam."""


def read_polycam(root: Path) -> Capture:
    """Read ``keyframes`` of Polycam's raw data: images, cameras and optional depth maps of the
    same names.

    Poses are OpenGL camera-to-world, y up. Corrected images are undistorted, corrected cameras
    have loop closure.
    """
    images, cameras = _existing(root, _POLYCAM)[0]
    frames: list[FrameEntry] = []
    for image in list_files(images, SUFFIXES):
        path = cameras / f"{image.stem}.json"
        fields = read_json_object(path)
        own: dict[str, object] = {
            key: require_key(path, fields, name) for key, name in _INTRINSICS.items()
        }
        own |= _depth_of(root / "keyframes" / "depth" / f"{image.stem}.png")
        own["transform_matrix"] = [
            [require_key(path, fields, f"t_{row}{column}") for column in range(4)]
            for row in range(3)
        ]
        frames.append(FrameEntry(str(path), own | {"file_path": str(image)}, image=image))
    return training_capture(root, "polycam", FrameFile(root / "keyframes", frames))


def _depth_of(path: Path) -> dict[str, object]:
    return {"depth_file_path": str(path)} if path.is_file() else {}


def _existing(root: Path, places: Sequence[tuple[str, str]]) -> list[tuple[Path, Path]]:
    """Return the (image folder, cameras) pairs among ``places`` that exist, in this order."""
    pairs = [(root / images, root / cameras) for images, cameras in places]
    return [
        (images, cameras)
        for images, cameras in pairs
        if cameras.exists() and list_files(images, SUFFIXES)
    ]


POLYCAM_FORMAT = CaptureFormat(
    "polycam",
    "keyframes/images and keyframes/cameras",
    lambda root: bool(_existing(root, _POLYCAM)),
    read_polycam,
)


def read_record3d(root: Path) -> Capture:
    """Read ``metadata.json`` and the images ``rgb/NUMBER.jpg`` of Record3D, or of an unpacked
    ``.r3d``.

    Poses are OpenGL camera-to-world: a quaternion xyzw and the position. ``K`` is stored column by
    column.
    """
    from scipy.spatial.transform import Rotation  # late: other captures do not need it

    images, path = _existing(root, _RECORD3D)[0]
    fields = read_json_object(path)
    poses = parse_numbers(f"{path}: poses", require_key(path, fields, "poses"), None).reshape(-1, 7)
    fx, _, _, _, fy, _, cx, cy, _ = parse_numbers(
        f"{path}: K", require_key(path, fields, "K"), (9,)
    )
    lenses = np.tile((fx, fy, cx, cy), (len(poses), 1))
    own_lenses = fields.get("perFrameIntrinsicCoeffs")
    if own_lenses:
        lenses = parse_numbers(f"{path}: perFrameIntrinsicCoeffs", own_lenses, (len(poses), 4))
    frames: list[FrameEntry] = []
    for image in list_files(images, SUFFIXES):
        if not image.stem.isdecimal():  # a copy, such as "12(1).jpg"
            continue
        number = int(image.stem)
        if number >= len(poses):
            raise DyngsError(
                f"{image}: has no pose: {path} has {len(poses)} poses, numbered from 0; export "
                "it again"
            )
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(poses[number, :4]).as_matrix()
        pose[:3, 3] = poses[number, 4:]
        own = dict(zip(("fl_x", "fl_y", "cx", "cy"), lenses[number].tolist(), strict=True))
        own |= _depth_of(images.parent / "depth" / f"{number}.exr")
        own |= {"file_path": str(image), "transform_matrix": pose.tolist()}
        frames.append(FrameEntry(f"{path}, pose {number}", own, fields, image))
    return training_capture(root, "record3d", FrameFile(root / "metadata.json", frames, fields))


RECORD3D_FORMAT = CaptureFormat(
    "record3d",
    "metadata.json and rgb (in EXR_RGBD)",
    lambda root: bool(_existing(root, _RECORD3D)),
    read_record3d,
)
