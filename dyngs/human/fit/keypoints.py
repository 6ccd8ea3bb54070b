"""2D key points of a person in images, as detectors write them: OpenPose and COCO.

Local letter: K key points of a format.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from torch import Tensor

from dyngs.data.capture import View
from dyngs.data.images.lens import undistorted_points
from dyngs.errors import DyngsError, reading
from dyngs.files.fields import numbers_of, read_json_object
from dyngs.human.template.joints import JOINT_NAMES

COCO = (
    *("nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder", "left_elbow"),
    *("right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle"),
    "right_ankle",
)
BODY_25 = (
    *("nose", "neck", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow", "left_wrist"),
    *("pelvis", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle", "right_eye"),
    "left_eye",
)
COCO_18 = (
    *("nose", "neck", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow", "left_wrist"),
    *("right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle", "right_eye", "left_eye"),
)
_MARKED = ("eye", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
"""Joints that detectors place where those of a body are; necks, collars and toes are elsewhere."""


def _marked(names: tuple[str, ...], count: int) -> tuple[str, ...]:
    """Return ``count`` names, those that are not joints of a body where they are marked, or not known, empty."""
    kept = [name if name.partition("_")[2] in _MARKED else "" for name in names]
    return (*kept, *[""] * (count - len(kept)))


_GOLIATH = (
    *("nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder", "left_elbow"),
    *("right_elbow", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle"),
)
_MHR = list(_marked(_GOLIATH, 70))
_MHR[41], _MHR[62] = "right_wrist", "left_wrist"
ORDERS: dict[str, tuple[str, ...]] = {
    "coco17": _marked(COCO, 17),
    "openpose25": _marked(BODY_25, 25),
    "smpl": (*JOINT_NAMES[:22], "", ""),
    "smplx_body": JOINT_NAMES[:22],
    "smplx": JOINT_NAMES,
    "mhr70": tuple(_MHR),
}
"""Orders of 3D joints by name; the number of joints tells them apart. Empty: a joint that is not used. ``mhr70`` is
that of SAM 3D Body."""
_SEEN = ("eye", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
"""Joints that detectors mark where they are, on both sides. Nose and ears are no joints; necks and toes are marked
elsewhere."""
JOINTS = {
    name: row for row, name in enumerate(JOINT_NAMES) if name.removeprefix("left_").removeprefix("right_") in _SEEN
}
"""Names of these joints, and their rows in ``JOINT_NAMES``."""
_FARTHEST = 1e6  # key points further away, px, are taken for mistakes
_ORDERS = {17: COCO, 133: COCO, 25: BODY_25, 18: COCO_18}
"""Number of key points of a format to the names of the first ones, as published."""
Keypoints = dict[str, Tensor]
"""Name of a view to (55, 3): column, row and confidence of joints in its stored image, undistorted; confidence 0
where a joint is not marked."""


def read_keypoints(path: Path, views: Sequence[View]) -> Keypoints:
    """Return the key points of the views: of a folder of OpenPose files, or of one COCO file.

    OpenPose: ``NAME_keypoints.json`` or ``NAME.json`` by the image's name, ``pose_keypoints_2d`` of 25 or 18 points.
    COCO: 17 or 133 points. Of several people the most confident one is taken. Raises DyngsError: neither, or no known
    view.
    """
    stems = by_stem(views)
    rows = _openpose(path, stems) if path.is_dir() else _coco(path, stems)
    if not rows:
        raise DyngsError(
            f"{path}: no key points for any image of the capture; files of OpenPose are called "
            "IMAGE_keypoints.json, and COCO's images have the images' names as file_name"
        )
    by_name = {view.name: view for view in views}
    return {name: _placed(by_name[name], joints) for name, joints in rows.items()}


def by_stem(views: Sequence[View]) -> dict[str, str]:
    """Return image name without folder and suffix to name of the view, and with the folder, too."""
    found: dict[str, str] = {}
    twice: set[str] = set()
    for view in views:
        stem = PurePosixPath(view.image_path.name).stem
        twice |= {stem} if stem in found else set()
        found[stem] = view.name
        found[view.name] = view.name
    return {stem: name for stem, name in found.items() if stem not in twice}


def _openpose(folder: Path, stems: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return view name to (K, 3) points of a folder of OpenPose files."""
    with reading(folder):
        files = sorted(folder.rglob("*.json"))
    found: dict[str, np.ndarray] = {}
    for file in files:
        stem = file.name.removesuffix(".json").removesuffix("_keypoints")
        name = stems.get(str(file.relative_to(folder).with_name(stem)), stems.get(stem))
        if name is None:
            continue
        people = read_json_object(file).get("people")
        if not isinstance(people, list):
            raise DyngsError(f"{file}: lacks the list 'people'; give files of OpenPose")
        points = [
            _points(file, "pose_keypoints_2d", person.get("pose_keypoints_2d"))
            for person in people
            if isinstance(person, dict)
        ]
        if points:
            found[name] = max(points, key=_confidence)
    return found


def _coco(file: Path, stems: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return view name to (K, 3) points of a COCO file."""
    if not file.is_file():
        raise DyngsError(f"{file}: no such file or folder of key points")
    fields = read_json_object(file)
    images, annotations = fields.get("images"), fields.get("annotations")
    if not isinstance(images, list) or not isinstance(annotations, list):
        raise DyngsError(f"{file}: lacks the lists 'images' and 'annotations' of COCO")
    names: dict[object, str] = {}
    for image in images:
        path = PurePosixPath(str(image.get("file_name"))) if isinstance(image, dict) else PurePosixPath()
        name = stems.get(str(path.with_suffix("")) if path.name else "", stems.get(path.stem))
        if name is not None and isinstance(image, dict) and isinstance(image.get("id"), (int, str)):
            names[image["id"]] = name
    found: dict[str, np.ndarray] = {}
    for person in annotations:
        number = person.get("image_id") if isinstance(person, dict) else None
        name = names.get(number) if isinstance(number, (int, str)) else None
        if name is not None and person.get("keypoints"):
            points = _points(file, "keypoints", person["keypoints"])
            points[:, 2] = np.minimum(points[:, 2], 2) / (2 if points[:, 2].max() > 1 else 1)
            found[name] = max((points, found.get(name, points)), key=_confidence)
    return found


def _points(file: Path, key: str, value: object) -> np.ndarray:
    """Return (K, 3) numbers of a list of column, row, confidence."""
    points = numbers_of(f"{file}: '{key}'", value, None).reshape(-1)
    if len(points) % 3 or len(points) // 3 not in _ORDERS:
        known = ", ".join(map(str, sorted(_ORDERS)))
        raise DyngsError(f"{file}: '{key}' holds {len(points) / 3:g} points of 3 numbers; known are {known}")
    return points.reshape(-1, 3)


def _confidence(points: np.ndarray) -> float:
    return float(points[:17, 2].sum())


def _placed(view: View, points: np.ndarray) -> Tensor:
    """Return the joints (55, 3) of the points of a format, undistorted."""
    joints = torch.zeros(len(JOINT_NAMES), 3, dtype=torch.float64, device="cpu")
    for row, name in enumerate(_ORDERS[len(points)]):
        if name in JOINTS and points[row, 2] > 0:
            joints[JOINTS[name]] = torch.from_numpy(points[row])
    positions = undistorted_points(view.lens, view.intrinsics, joints[:, :2])
    near = (positions.abs() < _FARTHEST).all(1, keepdim=True)  # false for NaN
    return torch.cat([torch.where(near, positions, 0.0), joints[:, 2:].clamp(0, 1) * near], dim=1).float()
