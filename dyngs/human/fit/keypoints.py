"""2D key points of a person in images (OpenPose, COCO), and fits of other programs as 3D joints.

Local letters: K key points or joints of a format, N vertices.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from dyngs.core.errors import DyngsError, reading
from dyngs.data.capture import Capture, View
from dyngs.data.images.lens import undistorted_points
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.io.fields import (
    LARGEST,
    entry,
    first_few,
    float_array,
    numbers_of,
    read_json_object,
    require_at_most,
)
from dyngs.io.numpy_files import read_arrays, read_npz
from dyngs.io.pickles import read_pickle

COCO = (
    *(
        "nose",
        "left_eye",
        "right_eye",
        "left_ear",
        "right_ear",
        "left_shoulder",
        "right_shoulder",
        "left_elbow",
    ),
    *(
        "right_elbow",
        "left_wrist",
        "right_wrist",
        "left_hip",
        "right_hip",
        "left_knee",
        "right_knee",
        "left_ankle",
    ),
    "right_ankle",
)
BODY_25 = (
    *(
        "nose",
        "neck",
        "right_shoulder",
        "right_elbow",
        "right_wrist",
        "left_shoulder",
        "left_elbow",
        "left_wrist",
    ),
    *(
        "pelvis",
        "right_hip",
        "right_knee",
        "right_ankle",
        "left_hip",
        "left_knee",
        "left_ankle",
        "right_eye",
    ),
    "left_eye",
)
COCO_18 = (
    *(
        "nose",
        "neck",
        "right_shoulder",
        "right_elbow",
        "right_wrist",
        "left_shoulder",
        "left_elbow",
        "left_wrist",
    ),
    *(
        "right_hip",
        "right_knee",
        "right_ankle",
        "left_hip",
        "left_knee",
        "left_ankle",
        "right_eye",
        "left_eye",
    ),
)
_MARKED = ("eye", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
"""Joints that detectors place where those of a body are; necks, collars and toes are elsewhere."""


def _marked(names: tuple[str, ...], count: int) -> tuple[str, ...]:
    """Return ``count`` names, those that are not joints of a body where they are marked, or not
    known, empty."""
    kept = [name if name.partition("_")[2] in _MARKED else "" for name in names]
    return (*kept, *[""] * (count - len(kept)))


_GOLIATH = (
    *(
        "nose",
        "left_eye",
        "right_eye",
        "left_ear",
        "right_ear",
        "left_shoulder",
        "right_shoulder",
        "left_elbow",
    ),
    *(
        "right_elbow",
        "left_hip",
        "right_hip",
        "left_knee",
        "right_knee",
        "left_ankle",
        "right_ankle",
    ),
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
"""Orders of 3D joints by name; the number of joints tells them apart. Empty: a joint that is not
used. ``mhr70`` is that of SAM 3D Body."""
_SEEN = ("eye", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
"""Joints that detectors mark where they are, on both sides. Nose and ears are no joints; necks and
toes are marked elsewhere."""
JOINTS = {
    name: row
    for row, name in enumerate(JOINT_NAMES)
    if name.removeprefix("left_").removeprefix("right_") in _SEEN
}
"""Names of these joints, and their rows in ``JOINT_NAMES``."""
_FARTHEST = 1e6  # key points further away, px, are taken for mistakes
_ORDERS = {17: COCO, 133: COCO, 25: BODY_25, 18: COCO_18}
"""Number of key points of a format to the names of the first ones, as published."""
Keypoints = dict[str, Tensor]
"""Name of a view to (55, 3): column, row and confidence of joints in its stored image, undistorted;
confidence 0 where a joint is not marked."""


def read_keypoints(path: Path, views: Sequence[View]) -> Keypoints:
    """Return the key points of the views: of a folder of OpenPose files, or of one COCO file.

    OpenPose: ``NAME_keypoints.json`` or ``NAME.json`` by the image's name, ``pose_keypoints_2d`` of
    25 or 18 points. COCO: 17 or 133 points. Of several people the most confident one is taken.
    Raises DyngsError: neither, or no known view.
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
        name = stems.get(file.relative_to(folder).with_name(stem).as_posix(), stems.get(stem))
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
    images = fields.get("images")
    annotations = fields.get("annotations")
    if not isinstance(images, list) or not isinstance(annotations, list):
        raise DyngsError(f"{file}: lacks the lists 'images' and 'annotations' of COCO")
    names: dict[object, str] = {}
    for image in images:
        path = (
            PurePosixPath(str(image.get("file_name")))
            if isinstance(image, dict)
            else PurePosixPath()
        )
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
        raise DyngsError(
            f"{file}: '{key}' holds {len(points) / 3:g} points of 3 numbers; known are {known}"
        )
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
    return torch.cat(
        [torch.where(near, positions, 0.0), joints[:, 2:].clamp(0, 1) * near], dim=1
    ).float()


NUM_JOINTS = 22  # joints of the body without hands and face, the same in SMPL, SMPL-H and SMPL-X
# a vertex tells where a joint is if it follows that joint and its parent by this fraction at least
NEAR = 0.5


def joints_of_vertices(where: Path, body: BodyTemplate, vertices: np.ndarray) -> np.ndarray:
    """Return the joints (F, 22, 3) of posed vertices (F, N, 3) of a body with N vertices; NaN where
    they do not tell.

    The vertices around a joint, which follow it or its parent, are moved from rest to the pose by
    the similarity that fits them best (Umeyama 1991); so is the joint. Raises DyngsError: another
    number of vertices; names ``where``.
    """
    rest = body.vertices.double().cpu().numpy()
    joints = body.joints.double().cpu().numpy()
    if vertices.ndim != 3 or vertices.shape[1:] != rest.shape:
        raise DyngsError(
            f"{where}: 'vertices' has the shape {'x'.join(map(str, vertices.shape))}, the body {len(rest)} of them; "
            "give the body file that they belong to (--body)"
        )
    weights = body.weights.double().cpu().numpy()
    found = np.full((len(vertices), NUM_JOINTS, 3), np.nan)
    for joint, parent in enumerate(body.parents[:NUM_JOINTS]):
        own = weights[:, joint] + (weights[:, parent] if parent >= 0 else 0.0)
        near = (
            np.minimum(weights[:, joint], weights[:, parent]) if parent >= 0 else weights[:, joint]
        )
        rows = np.flatnonzero((own > NEAR) & (near > 0.05))
        if len(rows) >= 4:
            found[:, joint] = [
                _moved(rest[rows], posed[rows].astype(np.float64), joints[joint])
                for posed in vertices
            ]
    return found


def _moved(rest: np.ndarray, posed: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the point (3,) moved by the similarity that takes points (P, 3) from rest to where
    they are posed."""
    if not np.isfinite(posed).all():
        return np.full(3, np.nan)
    middle = rest.mean(0)
    place = posed.mean(0)
    u, s, v = np.linalg.svd((posed - place).T @ (rest - middle))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v)) or 1.0])
    scale = (s * signs).sum() / max(float(((rest - middle) ** 2).sum()), 1e-12)
    return place + scale * (u * signs) @ v @ (point - middle)


Space = Literal["world", "camera"]
INNER = 0.3
"""Confidence of joints inside the trunk, which differ from model to model by centimetres, over that
of limbs."""
_MHR_JOINTS = 70
_MOST_FRAMES = 100_000
# from the axes of a camera of OpenGL, y up and looking along -z, to those of OpenCV
_TURNED = (1.0, -1.0, -1.0)
Joints3D = dict[int, Tensor]
"""Frame number to (55, 4): place in the world of the cameras and confidence, 0 where a joint is not
known."""


@dataclass(frozen=True)
class _Found:
    """Joints as a file has them."""

    # key of a frame (its number, or the name of an image) to (K, 4), with confidence
    joints: Mapping[int | str, np.ndarray]
    order: str  # name of their order, in ``ORDERS``
    space: Space  # of their axes: the capture's world, or OpenCV's camera of the image


def read_joints(path: Path, capture: Capture, body: BodyTemplate) -> Joints3D:
    """Return the 3D joints of the frames of training; ``body`` is the template of vertices.

    ``.npz``: ``joints`` (F, K, 3 or 4: with confidence) or ``vertices`` (F, N, 3), ``frames`` (F,)
    numbers, ``order`` and ``space``. ``.json``: the same, ``joints`` mapping images or frame
    numbers to lists. A folder: files of SAM 3D Body, ``IMAGE.npz``. ``.pkl``: ``frame_data.pkl`` of
    Alldieck et al. (2018). Raises DyngsError: another layout, no frame of the capture, or no
    numbers; names the file.
    """
    views = capture.splits["train"]
    with reading(path):
        found = _read(path, body)
    frames = _by_frame(path, found, views)
    if not frames:
        raise DyngsError(
            f"{path}: no joints for any frame of the capture; name them by their numbers or by the names of images "
            f"({first_few(sorted(map(str, found.joints)))} in the file, {views[0].name} in the capture)"
        )
    return {
        frame: _placed_in_3d(found, joints, view, capture)
        for frame, (joints, view) in frames.items()
    }


def _read(path: Path, body: BodyTemplate) -> _Found:
    if path.is_dir():
        return _of_sam_3d_body(path)
    if not path.is_file():
        raise DyngsError(f"{path}: no such file or folder of 3D joints")
    match path.suffix.lower():
        case ".json":
            return _of_json(path)
        case ".npz":
            return _of_npz(path, body)
        case ".pkl":
            return _of_frame_data(path, body)
    raise DyngsError(
        f"{path}: 3D joints are read from .npz, .json, frame_data.pkl, and folders of SAM 3D Body"
    )


def _of_json(path: Path) -> _Found:
    fields = read_json_object(path)
    listed = entry(path, fields, "joints")
    if not isinstance(listed, dict) or not listed:
        raise DyngsError(
            f"{path}: 'joints' must be an object of frames and their joints; export it again"
        )
    require_at_most(path, len(listed), _MOST_FRAMES, "frames")
    joints = {
        int(name) if re.fullmatch("[0-9]{1,9}", name) else name: _joints_of(
            f"{path}, joints of {name:.40}", value
        )
        for name, value in listed.items()
    }
    return _checked(path, joints, fields.get("order"), fields.get("space"))


def _of_npz(path: Path, body: BodyTemplate) -> _Found:
    known = ("joints", "vertices", "frames", "order", "space")
    found = read_arrays(path, lambda names: [name for name in known if name in names])
    given = entry(path, found, "vertices" if "vertices" in found else "joints")
    rows = joints_of_vertices(path, body, given) if "vertices" in found else given
    if rows.ndim != 3 or not len(rows):
        raise DyngsError(
            f"{path}: 'joints' must have the shape (frames, joints, 3 or 4); export it again"
        )
    require_at_most(path, len(rows), _MOST_FRAMES, "frames")
    numbers = found.get("frames", np.arange(len(rows)))
    if numbers.shape != (len(rows),) or numbers.dtype.kind not in "iu":
        raise DyngsError(
            f"{path}: 'frames' must hold one whole number for each row of 'joints'; export it again"
        )
    joints: dict[int | str, np.ndarray] = {
        int(number): _joints_of(f"{path}, row {i}", row)
        for i, (number, row) in enumerate(zip(numbers, rows, strict=True))
    }
    order = "smplx_body" if "vertices" in found else found.get("order")
    return _checked(path, joints, order, found.get("space"))


def _of_sam_3d_body(folder: Path) -> _Found:
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise DyngsError(f"{folder}: no .npz files of SAM 3D Body there")
    require_at_most(folder, len(files), _MOST_FRAMES, "files")
    joints: dict[int | str, np.ndarray] = {}
    for file in files:
        found = read_npz(file, ("pred_keypoints_3d", "pred_cam_t"))
        points, place = (float_array(found[name]) for name in ("pred_keypoints_3d", "pred_cam_t"))
        if points is None or place is None or points.size != 3 * _MHR_JOINTS or place.size != 3:
            raise DyngsError(
                f"{file}: must hold 'pred_keypoints_3d' ({_MHR_JOINTS}, 3) and 'pred_cam_t' (3) of one person; save "
                "one person per file"
            )
        joints[file.stem] = _joints_of(str(file), points.reshape(-1, 3) + place.reshape(3))
    return _checked(folder, joints, "mhr70", "camera")


def _of_frame_data(path: Path, body: BodyTemplate) -> _Found:
    fields = read_pickle(path)
    vertices = float_array(entry(path, fields, "vertices"))
    if vertices is None:
        raise DyngsError(f"{path}: 'vertices' must hold numbers; export it again")
    rows = joints_of_vertices(path, body, vertices) * np.array(_TURNED)
    joints: dict[int | str, np.ndarray] = {
        i: _joints_of(f"{path}, frame {i}", row) for i, row in enumerate(rows)
    }
    return _checked(path, joints, "smplx_body", "camera")


def _joints_of(where: str, value: object) -> np.ndarray:
    """Return (K, 4) joints with confidence; where a joint holds what is not finite, 0."""
    array = float_array(value)
    if array is None or array.ndim != 2 or array.shape[1] not in (3, 4):
        raise DyngsError(f"{where}: joints must be lists of 3 or 4 numbers; export it again")
    if array.shape[1] == 3:
        array = np.concatenate([array, np.ones((len(array), 1))], axis=1)
    known = np.isfinite(array).all(axis=1, keepdims=True)
    near = (np.abs(np.nan_to_num(array)) <= LARGEST).all(axis=1, keepdims=True)
    return np.where(np.logical_and(known, near), array, 0.0)


def _checked(
    path: Path, joints: Mapping[int | str, np.ndarray], order: object, space: object
) -> _Found:
    count = len(next(iter(joints.values())))
    by_count = {len(names): name for name, names in ORDERS.items()}
    wanted = by_count.get(count, "") if order is None else str(order)
    if wanted not in ORDERS:
        known = ", ".join(f"{name} ({len(names)})" for name, names in ORDERS.items())
        raise DyngsError(
            f"{path}: the order of {count} joints is not known; 'order' is one of {known}"
        )
    strange = next((key for key, rows in joints.items() if len(rows) != len(ORDERS[wanted])), None)
    if strange is not None:
        raise DyngsError(
            f"{path}: frame {strange} has {len(joints[strange])} joints, {wanted} has {len(ORDERS[wanted])}; export it "
            "again"
        )
    axes = "world" if space is None else str(space)
    if axes == "world":
        return _Found(joints, wanted, "world")
    if axes == "camera":
        return _Found(joints, wanted, "camera")
    raise DyngsError(f"{path}: 'space' must be world or camera; export it again")


def _by_frame(
    path: Path, found: _Found, views: Sequence[View]
) -> dict[int, tuple[np.ndarray, View]]:
    """Return frame number to joints and the view that they are for."""
    stems = by_stem(views)
    named = {view.name: view for view in views}
    first: dict[int, View] = {}
    for view in views:
        first.setdefault(-1 if view.frame is None else view.frame, view)
    frames: dict[int, tuple[np.ndarray, View]] = {}
    for key, joints in found.joints.items():
        name = stems.get(str(PurePosixPath(str(key)).with_suffix("")) if str(key) else "", "")
        view = (
            first.get(key) if isinstance(key, int) else named.get(name or stems.get(str(key), ""))
        )
        if view is None:
            continue
        if (
            found.space == "camera"
            and isinstance(key, int)
            and len({view.camera_id for view in views}) > 1
        ):
            raise DyngsError(
                f"{path}: joints of a camera need the names of images, not frame numbers"
            )
        frames[-1 if view.frame is None else view.frame] = (joints, view)
    return frames


def _placed_in_3d(found: _Found, joints: np.ndarray, view: View, capture: Capture) -> Tensor:
    """Return the joints (55, 4) of a frame in the scene coordinates of ``capture``."""
    placed = torch.zeros(len(JOINT_NAMES), 4, device="cpu")
    positions = (joints[:, :3] - capture.world_offset) / capture.world_scale
    if found.space == "camera":
        rotation = view.cam_from_world[:3, :3]
        shift = view.cam_from_world[:3, 3]
        positions = (joints[:, :3] / capture.world_scale - shift) @ rotation
    for row, name in enumerate(ORDERS[found.order]):
        if name in JOINT_NAMES and joints[row, 3] > 0:
            confidence = min(joints[row, 3], 1.0) * (1.0 if name in JOINTS else INNER)
            known = np.append(positions[row], confidence)
            placed[JOINT_NAMES.index(name)] = torch.from_numpy(known).float()
    return placed
