"""Orders of joints and key points of other programs: names as in ``JOINT_NAMES`` where the joint is there."""

from __future__ import annotations

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
