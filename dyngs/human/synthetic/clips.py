"""Clips of synthetic people: a walk, a squat, and random ones, chosen by a seed."""

from __future__ import annotations

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from dyngs.human.body.body import BodyTemplate, posed_vertices
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.motion.motion import Motion

FPS = 12.0
_Rotations = dict[str, np.ndarray]  # axis-angle vectors (F, 3) or (1, 3) by joint, rad
_SIDES = (("left", 1.0), ("right", -1.0))
_KEY_POSES = 4  # poses that a random clip passes through


def walk(body: BodyTemplate, num_frames: int) -> Motion:
    """Return three swings of legs and arms in place while the body turns by 50 degrees; soles at y
    = 0."""
    return _grounded_motion(body, _walk(np.linspace(0.0, 1.0, num_frames), 1.0, 0.0), num_frames)


def squat(body: BodyTemplate, num_frames: int) -> Motion:
    """Return a motion from standing into a squat while the arms rise sideways; soles at y = 0."""
    return _grounded_motion(body, _squat(np.linspace(0.0, 1.0, num_frames), 1.0, 0.0), num_frames)


def random_clip(body: BodyTemplate, num_frames: int, seed: int) -> Motion:
    """Return the clip of ``seed``: a walk, a squat or a dance, of random extent and heading; soles
    at y = 0.

    A dance passes smoothly through random poses: arms from hanging to above the shoulders, legs in
    steps.
    """
    make = np.random.default_rng([seed, 2])
    time = np.linspace(0.0, 1.0, num_frames)
    heading = float(make.uniform(-np.pi, np.pi))
    match int(make.integers(4)):
        case 0:
            rotations = _walk(time, float(make.uniform(0.5, 1.2)), heading)
        case 1:
            rotations = _squat(time, float(make.uniform(0.4, 1.0)), heading)
        case _:
            rotations = _dance(time, make, heading)
    return _grounded_motion(body, rotations, num_frames)


def _walk(time: np.ndarray, extent: float, heading: float) -> _Rotations:
    """Return the rotations of a walk at ``time`` (F,) in [0, 1]; ``heading`` in rad."""
    swing = extent * np.sin(3 * np.pi * time)
    lift = 0.3 - 0.3 * np.cos(3 * np.pi * time)
    rotations = {
        "pelvis": _axis_angle(y=np.radians(50.0) * (time - 0.5) + heading),
        "spine2": _axis_angle(y=0.2 * swing),
        "head": _axis_angle(y=0.5 * np.sin(2 * np.pi * time)),
    }
    for side, sign in _SIDES:
        rotations |= {
            f"{side}_hip": _axis_angle(x=-0.5 * sign * swing),
            f"{side}_knee": _axis_angle(x=0.2 + 0.6 * np.maximum(-sign * swing, 0.0) + 0.3 * lift),
            f"{side}_shoulder": _axis_angle(x=0.6 * sign * swing, z=-sign * 1.15),
            f"{side}_elbow": _axis_angle(y=-sign * (0.3 + lift)),
        }
    return rotations


def _squat(time: np.ndarray, extent: float, heading: float) -> _Rotations:
    depth = extent * (0.5 - 0.5 * np.cos(np.pi * time))
    rotations = {
        "spine1": _axis_angle(x=0.35 * depth),
        "head": _axis_angle(x=-0.3 * depth, z=0.2 * depth),
    }
    if heading:
        rotations["pelvis"] = _axis_angle(y=heading)
    for side, sign in _SIDES:
        rotations |= {
            f"{side}_hip": _axis_angle(x=-1.3 * depth, z=0.15 * sign * depth),
            f"{side}_knee": _axis_angle(x=1.9 * depth),
            f"{side}_ankle": _axis_angle(x=-0.6 * depth),
            f"{side}_shoulder": _axis_angle(z=sign * (-1.2 + 2.1 * depth)),
            f"{side}_elbow": _axis_angle(y=-0.4 * sign * depth),
        }
    return rotations


def _dance(time: np.ndarray, make: np.random.Generator, heading: float) -> _Rotations:

    def between(low: float, high: float) -> np.ndarray:
        knots = make.uniform(low, high, _KEY_POSES)
        return PchipInterpolator(np.linspace(0.0, 1.0, _KEY_POSES), knots)(time)

    rotations = {
        "pelvis": _axis_angle(y=heading + between(-0.5, 0.5)),
        "spine1": _axis_angle(x=between(-0.05, 0.3), y=between(-0.2, 0.2), z=between(-0.12, 0.12)),
        "spine2": _axis_angle(y=between(-0.2, 0.2), z=between(-0.12, 0.12)),
        "head": _axis_angle(x=between(-0.25, 0.25), y=between(-0.6, 0.6), z=between(-0.15, 0.15)),
    }
    for side, sign in _SIDES:
        bent = between(0.0, 1.0)
        rotations |= {
            f"{side}_hip": _axis_angle(
                x=-0.9 * bent + 0.2, y=sign * between(0.0, 0.3), z=sign * between(0.02, 0.35)
            ),
            f"{side}_knee": _axis_angle(x=between(0.0, 0.3) + 0.9 * bent),
            f"{side}_shoulder": _axis_angle(
                x=between(-0.4, 0.4), y=-sign * between(-0.2, 0.7), z=sign * between(-1.2, 0.5)
            ),
            f"{side}_elbow": _axis_angle(x=between(-0.3, 0.3), y=-sign * between(0.05, 1.5)),
        }
    return rotations


def _grounded_motion(body: BodyTemplate, rotations: _Rotations, num_frames: int) -> Motion:
    """Return the motion of joints rotated by axis-angle (F, 3) or (3,), the lowest vertex always at
    y = 0."""
    device = body.vertices.device
    poses = torch.zeros(num_frames, len(JOINT_NAMES), 3, device=device)
    for name, rotation in rotations.items():
        poses[:, JOINT_NAMES.index(name)] = torch.from_numpy(rotation).to(poses)
    trans = torch.zeros(num_frames, 3, device=device)
    exact = body.to(dtype=torch.float64)
    for frame, pose in enumerate(poses.double()):
        trans[frame, 1] = (
            -posed_vertices(
                exact, pose[None], torch.zeros(1, 3, dtype=torch.float64, device=device)
            )[0, :, 1]
            .min()
            .float()
        )
    return Motion(
        poses, trans, torch.zeros(10, device=device), FPS, torch.ones(num_frames, device=device)
    )


def _axis_angle(
    x: np.ndarray | float = 0.0, y: np.ndarray | float = 0.0, z: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return axis-angle vectors (F, 3) of rotations about the fixed axes z, then y, then x by
    angles (F,), rad."""
    angles = np.stack(np.broadcast_arrays(np.atleast_1d(z), y, x), axis=-1)
    return Rotation.from_euler("zyx", angles).as_rotvec()
