"""Readers of 2D key points (OpenPose, COCO) and of 3D joints fitted by other programs.

Symbol: K key points or joints of a format.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from torch import Tensor

from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.data.body_frames import frame_number
from dyngs.data.capture import Capture, View
from dyngs.data.images.lens import undistort_points
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.io.fields import LARGEST, as_float_array, parse_numbers, read_json_object
from dyngs.io.numpy_files import read_npz

_COCO = """
nose left_eye right_eye left_ear right_ear left_shoulder right_shoulder left_elbow right_elbow left_wrist
right_wrist left_hip right_hip left_knee right_knee left_ankle right_ankle
"""
# Neck and pelvis (-) are defined differently from body joints.
_BODY_25 = """
nose - right_shoulder right_elbow right_wrist left_shoulder left_elbow left_wrist - right_hip right_knee
right_ankle left_hip left_knee left_ankle right_eye left_eye
"""
_MHR_70 = f"""
nose left_eye right_eye left_ear right_ear left_shoulder right_shoulder left_elbow right_elbow left_hip right_hip
left_knee right_knee left_ankle right_ankle {26 * "- "} right_wrist {20 * "- "} left_wrist
"""
# After the body: the feet, the face, and 21 points of each hand.
_WHOLE_BODY: str = f"""
{_COCO} left_toe - left_heel right_toe - right_heel {68 * "- "}
{5 * "- "} left_index1 {11 * "- "} left_pinky1 {3 * "- "}
{5 * "- "} right_index1 {11 * "- "} right_pinky1 {3 * "- "}
"""
_IN_IMAGES = {
    17: _COCO.split(),
    133: _WHOLE_BODY.split(),
    25: f"{_BODY_25} - - left_toe - left_heel right_toe - right_heel".split(),
    18: _BODY_25.replace("left_wrist -", "left_wrist").split(),
}
"""Names of the first 2D key points by the number of key points in the format."""
_IN_SPACE = {
    17: _COCO.split(),
    25: _BODY_25.split(),
    70: _MHR_70.split(),
    22: JOINT_NAMES[:22],
    24: JOINT_NAMES[:22],
    55: JOINT_NAMES,
}
"""Names of the first 3D joints by number of joints: COCO, OpenPose, SAM 3D Body, SMPL family."""
JOINTS = {
    name: row
    for row, name in enumerate(JOINT_NAMES)
    if name.partition("_")[2]
    in ("eye", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "foot", "index1", "pinky1")
}
"""Rows in ``JOINT_NAMES`` of joints that detectors place at the joint; necks are not. Those of the
feet follow from heels and toes."""
BALL_OF_FOOT = 0.72  # position of the foot's joint between heel (0) and tip of the toes (1)
KEY_POINTS: tuple[str, ...] = (
    *_COCO.split(),
    *("left_toe", "right_toe", "left_heel", "right_heel"),
    *("left_index1", "right_index1", "left_pinky1", "right_pinky1"),
)
"""Names of the K = 25 key points of a ``Detection``: those of COCO, then of feet and hands."""
WHOLE_BODY_ROWS = tuple(_WHOLE_BODY.split().index(name) for name in KEY_POINTS)
"""Rows of ``KEY_POINTS`` among the 133 key points of COCO-WholeBody."""
MIN_CONFIDENCE = 0.3
"""Confidence from which a key point is used."""
Keypoints = dict[str, Tensor]
"""By view name: (55, 3) column, row (undistorted, px of the stored image) and confidence; 0 for
missing joints."""
RelativeJoints = dict[str, Tensor]
"""By view name: (55, 4) estimated position relative to the hips, m, in axes of the camera, and 1;
0 for missing joints."""
Joints3D = dict[int, Tensor]
"""By frame number: (55, 4) position in world coordinates and confidence; 0 for missing joints."""


def _by_name(views: Sequence[View]) -> dict[str, View]:
    """Return the views by name, and by the file name of the image where that is unique."""
    stems = [PurePosixPath(view.image_path.name).stem for view in views]
    counts = Counter(stems)
    unique = {stem: view for stem, view in zip(stems, views, strict=True) if counts[stem] == 1}
    return unique | {view.name: view for view in views}


def _view_of(named: Mapping[str, View], name: str) -> View | None:
    return named.get(name, named.get(PurePosixPath(name).name))


def read_keypoints(path: Path, views: Sequence[View]) -> Keypoints:
    """Read the key points of views from a folder of OpenPose files or from a COCO file.

    OpenPose: ``NAME_keypoints.json`` or ``NAME.json`` per image, ``pose_keypoints_2d`` with 25 or
    18 points. COCO: 17 or 133 points (with feet and hands). The most confident of several people
    is used. Raises DyngsError: another format, or no view of the capture.
    """
    named = _by_name(views)
    keypoints: Keypoints = {}
    with wrap_read_errors(path):
        files = sorted(path.rglob("*.json")) if path.is_dir() else [path]
    for file in files:
        with wrap_read_errors(file, "give a folder of OpenPose files or a COCO file"):
            name = file.relative_to(path).as_posix().removesuffix(".json")
            name = name.removesuffix("_keypoints")
            if path.is_dir() and _view_of(named, name) is None:
                continue
            fields = read_json_object(file)
            if path.is_dir():
                people = [(name, person["pose_keypoints_2d"]) for person in fields["people"]]
            else:
                names = {x["id"]: x["file_name"].rpartition(".")[0] for x in fields["images"]}
                people = [(names[x["image_id"]], x["keypoints"]) for x in fields["annotations"]]
            for name, numbers in people:
                view = _view_of(named, name)
                if view is not None and numbers:
                    joints = _marked_joints(file, numbers, view)
                    best = keypoints.get(view.name, joints)
                    if joints[:, 2].sum() >= best[:, 2].sum():
                        keypoints[view.name] = joints
    if not keypoints:
        raise DyngsError(
            f"{path}: no key points for any image of the capture; name OpenPose files "
            "IMAGE_keypoints.json, or use the image names as file_name in COCO"
        )
    return keypoints


def read_relative_joints(path: Path, views: Sequence[View]) -> RelativeJoints:
    """Read the ``positions`` beside the key points of a COCO file, as `dyngs data people` writes
    them; empty without.

    Raises DyngsError: not 17 positions of three numbers.
    """
    if path.is_dir():
        return {}
    named = _by_name(views)
    relative: RelativeJoints = {}
    with wrap_read_errors(path, "give a folder of OpenPose files or a COCO file"):
        fields = read_json_object(path)
        names = {x["id"]: x["file_name"].rpartition(".")[0] for x in fields["images"]}
        for person in fields["annotations"]:
            view = _view_of(named, names[person["image_id"]])
            if view is None or "positions" not in person:
                continue
            points = parse_numbers(f"{path}: positions", person["positions"], (17, 3))
            joints = torch.zeros(len(JOINT_NAMES), 4, device="cpu")
            for name, point in zip(_IN_SPACE[17], points, strict=True):
                if name in JOINTS:
                    joints[JOINTS[name]] = torch.tensor([*point, 1.0], device="cpu")
            relative[view.name] = joints
    return relative


def _marked_joints(file: Path, numbers: object, view: View) -> Tensor:
    """Return the undistorted joints (55, 3) of a list of column, row, confidence."""
    points = parse_numbers(f"{file}: a list of key points", numbers, None).reshape(-1, 3)
    names = _IN_IMAGES.get(len(points))
    if names is None:
        raise DyngsError(
            f"{file}: a person has {len(points)} key points; supported are {sorted(_IN_IMAGES)}"
        )
    if points[:, 2].max() > 1:  # COCO: 1 hidden, 2 seen
        points[:, 2] = points[:, 2].clip(0, 2) / 2
    joints = torch.zeros(len(JOINT_NAMES), 3, dtype=torch.float64, device="cpu")
    for name, point in zip(names, points, strict=False):
        if name in JOINTS and point[2] > 0:
            joints[JOINTS[name]] = torch.from_numpy(point)
    for side in ("left", "right"):
        if f"{side}_toe" in names:
            toe, heel = (points[names.index(f"{side}_{part}")] for part in ("toe", "heel"))
            ball = heel + BALL_OF_FOOT * (toe - heel)
            ball[2] = min(toe[2], heel[2])
            if ball[2] > 0:
                joints[JOINTS[f"{side}_foot"]] = torch.from_numpy(ball)
    positions = undistort_points(view.lens, view.intrinsics, joints[:, :2])
    # Positions further away, px, and NaN are outliers.
    near = (positions.abs() < 1e6).all(1, keepdim=True)
    marked = [torch.where(near, positions, 0.0), joints[:, 2:].clamp(0, 1) * near]
    return torch.cat(marked, dim=1).float()


def read_joints(path: Path, capture: Capture) -> Joints3D:
    """Read the 3D joints of the training frames.

    ``.npz``: ``joints`` (F, K, 3 or 4 with confidence) in file coordinates, NaN where unknown, and
    frame numbers ``frames`` (F,). Folder: files of SAM 3D Body, ``IMAGE.npz`` with one person in
    camera coordinates. Raises DyngsError: another layout, no frame of the capture, or no numbers.
    """
    views = capture.splits["train"]
    scale = capture.world_scale
    joints: Joints3D = {}
    with wrap_read_errors(path):
        if path.is_dir():
            named = _by_name(views)
            for file in sorted(path.glob("*.npz")):
                if file.stem in named:
                    view = named[file.stem]
                    arrays = read_npz(file, ("pred_keypoints_3d", "pred_cam_t"))
                    points = arrays["pred_keypoints_3d"].reshape(70, 3)
                    points = (points + arrays["pred_cam_t"].reshape(3)) / scale
                    positions = (points - view.cam_from_world[:3, 3]) @ view.cam_from_world[:3, :3]
                    joints[frame_number(view)] = _placed_joints(file, positions)
        else:
            arrays = read_npz(path, ("joints",), ("frames",))
            rows = arrays["joints"].astype(np.float64)
            rows[..., :3] = (rows[..., :3] - capture.world_offset) / scale
            numbers = arrays.get("frames", np.arange(len(rows))).tolist()
            wanted_frames = {frame_number(view) for view in views}
            for number, row in zip(numbers, rows, strict=True):
                if number in wanted_frames:
                    joints[number] = _placed_joints(path, row)
    if not joints:
        raise DyngsError(
            f"{path}: no joints for any frame of the capture; give frame numbers, or name SAM 3D "
            "Body files like the images"
        )
    return joints


def _placed_joints(file: Path, values: object) -> Tensor:
    """Return the joints (55, 4) of (K, 3 or 4) positions and confidences.

    Joints inside the trunk, whose definitions differ by centimetres, get 0.3 of the confidence.
    """
    rows = as_float_array(values)
    if rows is None or rows.ndim != 2 or rows.shape[1] not in (3, 4) or len(rows) not in _IN_SPACE:
        raise DyngsError(
            f"{file}: 'joints' must be (frames, joints, 3 or 4) numbers of {sorted(_IN_SPACE)} "
            "joints; export it again"
        )
    placed = torch.zeros(len(JOINT_NAMES), 4, device="cpu")
    for name, row in zip(_IN_SPACE[len(rows)], rows, strict=False):
        if name in JOINT_NAMES and (np.abs(row) <= LARGEST).all():
            confidence = min(max(row[3], 0.0), 1.0) if len(row) == 4 else 1.0
            known = [*row[:3], confidence * (1.0 if name in JOINTS else 0.3)]
            placed[JOINT_NAMES.index(name)] = torch.tensor(known, device="cpu")
    return placed
