"""The motion of a captured person: body parameters of the frames that have pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.data.body_frames import BodyFrames, about_pelvis, rows_of
from dyngs.data.capture import View
from dyngs.human.motion.clip import MotionClip
from dyngs.human.template.joints import SMPLX_ROWS


@dataclass(frozen=True)
class CapturedMotion:
    """The frames of a clip that have pictures.

    Attributes:
        clip: F moments.
        frames: (F,) frame number of each, as views name them.
    """

    clip: MotionClip
    frames: tuple[int, ...]


def captured_motion(where: Path, given: BodyFrames, views: Sequence[View], joints: Tensor) -> CapturedMotion:
    """The frames of ``given`` that ``views`` show, for a body with ``joints`` (J, 3) at rest.

    Joints that the body of ``given`` lacks do not turn. Views without times are spread over [0, 1] by frame number.

    Args:
        where: the capture, for messages.
        given: body parameters.
        views: V >= 1 views.
        joints: of the shaped template.

    Raises:
        DyngsError: a view without parameters.
    """
    found = about_pelvis(given, joints[0].double().numpy())
    rows = rows_of(where, found, views)
    last = max(len(found.frames) - 1, 1)
    moments = {
        row: row / last if view.time is None else view.time for view, row in zip(views, rows.tolist(), strict=True)
    }
    order = sorted(moments, key=lambda row: (moments[row], row))
    kept = [row for i, row in enumerate(order) if i == 0 or moments[row] > moments[order[i - 1]]]
    return CapturedMotion(
        MotionClip(
            times=torch.tensor([moments[row] for row in kept], dtype=torch.float64),
            poses=_for_joints(torch.from_numpy(found.poses[kept]).float(), len(joints)),
            trans=torch.from_numpy(found.trans[kept]).float(),
            scale=torch.from_numpy(found.scale[kept]).float(),
        ),
        tuple(found.frames[row] for row in kept),
    )


def same_bodies(a: BodyFrames, b: BodyFrames) -> bool:
    """Whether both hold the same bodies in the same frames."""
    pairs = ((getattr(a, name), getattr(b, name)) for name in ("poses", "trans", "scale"))
    return a.frames == b.frames and all(np.array_equal(x, y) for x, y in pairs)


def _for_joints(poses: Tensor, count: int) -> Tensor:
    """(F, count, 3) of poses of another body's joints (F, J, 3); joints that one of them lacks do not turn."""
    if poses.shape[1] == count:
        return poses
    known = poses.new_zeros(len(poses), 55, 3)
    theirs, ours = SMPLX_ROWS[poses.shape[1]], SMPLX_ROWS[count]
    known[:, list(theirs)] = poses[:, : len(theirs)]
    wanted = poses.new_zeros(len(poses), count, 3)
    wanted[:, : len(ours)] = known[:, list(ours)]
    return wanted
