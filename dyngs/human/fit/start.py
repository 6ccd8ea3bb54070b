"""First poses of a person of whom only silhouettes are known: where they stand, how they face,
frame after frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.data.images.maps import silhouette_box
from dyngs.data.times import evenly_spaced
from dyngs.human.avatar.posing import posed_joints
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.fit.silhouettes import ObservedFrame, Surface
from dyngs.human.fit.solve import (
    NUM_TURNED,
    Fitting,
    InTurn,
    Observations,
    frame_pose_of,
    keypoint_error,
    mean_error,
    new_fit,
    prior,
    usual,
    usual_pose,
)
from dyngs.human.motion.motion import MotionClip

NUM_HEADINGS = 8  # directions that a person may face, all of which are tried in every anchor
LIKELY = 3  # of these, nearest to the key points, that are tried where there are some
MOST_ANCHORS = 20  # frames in which headings are tried
CHANGE_WEIGHT = 0.01
"""Error that costs as much as a turn of 45 degrees from one anchor to the next; it grows with the
square."""


def likely_path(errors: Sequence[Sequence[float]], weight: float = CHANGE_WEIGHT) -> list[int]:
    """Return the heading (A,) of each anchor for which errors (A, H) and changes of heading cost
    least in all.

    Source: the algorithm of Viterbi, 1967.
    """
    costs = np.asarray(errors, dtype=np.float64)
    count = costs.shape[1]
    apart = np.abs(np.arange(count)[:, None] - np.arange(count))
    change = weight * (np.minimum(apart, count - apart) * (8 / count)) ** 2
    total = costs[0]
    came_from = []
    for own in costs[1:]:
        ways = total[:, None] + change
        came_from.append(ways.argmin(0))
        total = ways.min(0) + own
    path = [int(total.argmin())]
    for back in reversed(came_from):
        path.append(int(back[path[-1]]))
    return path[::-1]


def roots_between(anchors: Sequence[int], roots: Tensor, count: int) -> Tensor:
    """Return rotations (count, 3) of the root, axis-angle, rad: those (A, 3) of the anchors, turned
    on between them.

    Before the first anchor and after the last one they stay.
    """
    if len(anchors) == 1:
        return roots.expand(count, 3).clone()
    between = Slerp(np.asarray(anchors, dtype=np.float64), Rotation.from_rotvec(roots.numpy()))
    rows = np.clip(np.arange(count, dtype=np.float64), anchors[0], anchors[-1])
    return torch.from_numpy(between(rows).as_rotvec()).to(roots)


def angle_between(a: Tensor, b: Tensor) -> float:
    """Return the angle, rad, of the rotation from ``a`` (3,) to ``b`` (3,), both axis-angle."""
    return float(
        (Rotation.from_rotvec(a.numpy()).inv() * Rotation.from_rotvec(b.numpy())).magnitude()
    )


def heading(index: int) -> float:
    """Return the angle about the vertical, rad, of the heading ``index``."""
    return 2 * math.pi * index / NUM_HEADINGS


STEPS = 40
"""Steps of Adam for each heading of an anchor, and, at each size, for each frame from the pose of
the one before."""
OFF_COURSE = math.radians(30)
"""Rotation of the root away from the path of headings from which a frame is begun on that path
instead."""
ARMS = (((0, 0, -75), (0, 0, 0)), ((0, 0, 0), (0, 0, 0)), ((0, -30, -60), (0, -90, 0)))
"""Rotations of the left shoulder and elbow, degrees, that are tried: hanging, spread, bent
forward."""
# headings of the first frame from which clips without key points are followed without the path, too
_WITHOUT_PATH = 2
MOMENTUM = 0.8
"""Fraction of the last rotation that is expected again, so that legs which pass each other are not
exchanged."""
STATURE = 1.70  # height of a person in a usual pose, m, where a single camera leaves it open
PELVIS_FRACTION = 0.53  # height of the pelvis, of that of the person


def first_poses(
    times: Tensor, surface: Surface, observed: Observations, tick: Callable[[], None] = lambda: None
) -> MotionClip:
    """Return poses of a person in F frames, found in the silhouettes of ``observed`` (per row)
    alone.

    In some frames, the anchors, every heading is tried; a likely path through them says which way
    the person faces. Each frame starts from the pose of the one before, and where that has left the
    path from the path's heading. Without key points clips that never look at the path are compared
    with it. Raises ValueError: nobody in the first frame.
    """
    seen = observed(0)
    if seen is None:
        raise ValueError("nobody is seen in the first frame")
    standing = standing_clip(times, surface, observed)
    up = up_of(seen)
    shown = {
        row: frame
        for row in evenly_spaced(len(times), MOST_ANCHORS)
        if (frame := observed(row)) is not None
    }
    anchors = list(shown)
    tried = [_all_headings(standing, row, up, surface, shown[row], tick) for row in shown]
    path = likely_path([[error for _, _, error in own] for own in tried])
    roots = torch.stack([own[heading][0][0] for own, heading in zip(tried, path, strict=True)])
    ways: list[tuple[int, Tensor | None]] = [(path[0], roots_between(anchors, roots, len(times)))]
    if seen.joints is None:
        best = sorted(range(NUM_HEADINGS), key=lambda i: tried[0][i][2])
        ways += [(index, None) for index in best[:_WITHOUT_PATH]]
    followed = []
    for index, along in ways:
        pose, trans, error = tried[0][index]
        first = _with_better_arms(_with_row(standing, 0, pose, trans), error, surface, seen)
        followed.append(_followed(first, along, surface, observed, tick))
    return min(followed, key=lambda found: found[1])[0]


def num_ticks(frames: int, *, marked: bool) -> int:
    """Return how often ``first_poses`` calls ``tick`` for a clip of so many frames, with or without
    key points."""
    headings, ways = (LIKELY, 1) if marked else (NUM_HEADINGS, 1 + _WITHOUT_PATH)
    return headings * len(evenly_spaced(frames, MOST_ANCHORS)) + (frames - 1) * ways


def _all_headings(
    clip: MotionClip,
    row: int,
    up: Tensor,
    surface: Surface,
    seen: ObservedFrame,
    tick: Callable[[], None],
) -> list[tuple[Tensor, Tensor, float]]:
    """Return pose, translation and error of a frame as found from each heading; after the first at
    half the size.

    With key points only the ``LIKELY`` headings are tried, and the error of others is infinite.
    """
    starts = [turned(clip, heading(index), up) for index in range(NUM_HEADINGS)]
    errors = [_marked_error(start, row, surface, seen) for start in starts]
    likely = sorted(range(NUM_HEADINGS), key=errors.__getitem__)[
        : NUM_HEADINGS if seen.joints is None else LIKELY
    ]
    found = [(start.poses[row], start.trans[row], math.inf) for start in starts]
    for index in likely:
        levels = (2, 1) if row == 0 else (2,)
        found[index] = _found_from(starts[index], *found[index][:2], row, surface, seen, levels)
        tick()
    return found


@torch.no_grad()
def _marked_error(clip: MotionClip, row: int, surface: Surface, seen: ObservedFrame) -> float:
    """Return the error of the key points of a frame; 0 without any."""
    if seen.joints is None:
        return 0.0
    blank = new_fit(clip, surface)
    joints = posed_joints(surface.skeleton(blank["betas"]), frame_pose_of(blank, clip, row))
    return float(keypoint_error(joints, seen.joints, seen.cameras))


def _with_row(clip: MotionClip, row: int, pose: Tensor, trans: Tensor) -> MotionClip:
    poses = clip.poses.clone()
    positions = clip.trans.clone()
    poses[row], positions[row] = pose, trans
    return replace(clip, poses=poses, trans=positions)


def standing_clip(times: Tensor, surface: Surface, observed: Observations) -> MotionClip:
    """Return the usual pose, upright, at the place and in the size of the silhouettes of each
    frame.

    Where nobody is seen, the place is that of the frame before.
    """
    joints = surface.body.joints
    up = torch.zeros(3, device="cpu")
    positions = []
    heights = []
    for row in range(len(times)):
        seen = observed(row)
        if seen is None:
            positions.append(positions[-1] if positions else torch.zeros(3, device="cpu"))
            continue
        up = up if up.any() else up_of(seen)
        place, height = place_and_height(seen, up)
        positions.append(place)
        heights += [] if height is None else [height]
    upright = Rotation.align_vectors(up[None].numpy(), np.array([[0.0, 1.0, 0.0]]))[0]
    poses = usual_pose(len(joints)).to(joints).repeat(len(times), 1, 1)
    poses[:, 0] = torch.from_numpy(upright.as_rotvec()).to(poses)
    scale = float(np.median(heights)) / STATURE if heights else 1.0
    trans = torch.stack(positions) - scale * joints[0]  # the root turns about the pelvis
    return MotionClip(times, poses, trans, torch.full((len(times),), scale, device="cpu"))


def up_of(seen: ObservedFrame) -> Tensor:
    """Return the unit vector (3,) that points up in the images, a mean over cameras."""
    up = -seen.cameras.cam_from_world[:, 1, :3].mean(0)
    return up / up.norm()


def place_and_height(seen: ObservedFrame, up: Tensor) -> tuple[Tensor, float | None]:
    """Return the place (3,) of the pelvis in the world and the height of the person, None if one
    camera sees them."""
    rays = [_ray(seen.cameras.select(i), seen.alpha[i]) for i in range(len(seen))]
    rays = [ray for ray in rays if ray is not None]
    if not rays:
        return torch.zeros(3, device="cpu"), None
    starts, directions, angles = (torch.stack(x) for x in zip(*rays, strict=True))
    if len(rays) == 1:
        middle = starts[0] + directions[0] * STATURE / angles[0]
        height = None
    else:
        across = torch.eye(3, device="cpu") - directions[:, :, None] * directions[:, None]
        middle = torch.linalg.lstsq(across.sum(0), (across @ starts[..., None]).sum(0)).solution[
            :, 0
        ]
        height = float((angles * (middle - starts).norm(dim=1)).median())
    return middle + up * (PELVIS_FRACTION - 0.5) * (height or STATURE), height


def turned(clip: MotionClip, angle: float, up: Tensor) -> MotionClip:
    """Return the clip with the person turned by ``angle``, rad, about ``up`` through the pelvis."""
    turn = Rotation.from_rotvec(angle * up.numpy()) * Rotation.from_rotvec(clip.poses[:, 0].numpy())
    poses = clip.poses.clone()
    poses[:, 0] = torch.from_numpy(turn.as_rotvec()).to(poses)
    return replace(clip, poses=poses)


def _ray(camera: Cameras, alpha: Tensor) -> tuple[Tensor, Tensor, Tensor] | None:
    """Return start and unit direction (3,) of the ray through the middle of a silhouette, and its
    height as an angle.

    The angle is the height over the distance, for a person who stands upright in the image. None if
    nobody is seen.
    """
    box = silhouette_box(alpha, 0.5)
    if box is None:
        return None
    (top, bottom), (left, right) = ((part.start, part.stop) for part in box)
    middle = torch.tensor([(left + right) / 2, (top + bottom) / 2, 1.0], device="cpu")
    intrinsics = camera.intrinsics[0]
    pose = camera.cam_from_world[0]
    local = torch.linalg.solve(intrinsics, middle)
    direction = pose[:3, :3].T @ local
    return (
        camera.centers[0],
        direction / direction.norm(),
        (bottom - top) / (intrinsics[1, 1] * local.norm()),
    )


def _followed(
    clip: MotionClip,
    roots: Tensor | None,
    surface: Surface,
    observed: Observations,
    tick: Callable[[], None],
) -> tuple[MotionClip, float]:
    """Return the clip with the poses after the first frame found one by one, and the mean error of
    what is seen.

    ``roots`` (F, 3) is a path of headings to stay near; None: there is none.
    """
    poses = clip.poses.clone()
    trans = clip.trans.clone()
    errors = []
    for row in range(1, len(poses)):
        seen = observed(row)
        poses[row] = _extrapolated(poses, row)
        trans[row] = trans[row - 1] + clip.trans[row] - clip.trans[row - 1]
        if seen is not None:
            starts = [poses[row]]
            if roots is not None and angle_between(poses[row, 0], roots[row]) > OFF_COURSE:
                starts = [
                    torch.cat([roots[row : row + 1], others[1:]])
                    for others in (poses[row], clip.poses[row])
                ]
            found = [_found_from(clip, start, trans[row], row, surface, seen) for start in starts]
            poses[row], trans[row], error = min(found, key=lambda x: x[2])
            errors.append(error)
        tick()
    return replace(clip, poses=poses, trans=trans), sum(errors) / max(len(errors), 1)


def _with_better_arms(
    clip: MotionClip, error: float, surface: Surface, seen: ObservedFrame
) -> MotionClip:
    """Return the clip whose first frame has the arms that fit best, of those found from other
    positions as well.

    A forearm that starts in front of the trunk does not find its way out of it.
    """
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for shoulder, elbow in ARMS:
            pose = clip.poses[0].clone()
            for name, degrees in (("shoulder", shoulder), ("elbow", elbow)):
                turn = pose.new_tensor([degrees[0], sign * degrees[1], sign * degrees[2]])
                pose[JOINT_NAMES.index(f"{side}_{name}")] = torch.deg2rad(turn)
            pose, trans, found = _found_from(clip, pose, clip.trans[0], 0, surface, seen)
            if found < error:
                error = found
                clip = _with_row(clip, 0, pose, trans)
    return clip


def _found_from(
    clip: MotionClip,
    pose: Tensor,
    trans: Tensor,
    row: int,
    surface: Surface,
    seen: ObservedFrame,
    levels: tuple[int, ...] = (2, 1),
) -> tuple[Tensor, Tensor, float]:
    """Return pose (J, 3), translation and error of one frame, found from a start; unusual poses add
    to the error.

    ``levels`` are the factors by which what is seen is made smaller, one after the other.
    """
    one = MotionClip(clip.times[row : row + 1], pose[None], trans[None], clip.scale[row : row + 1])
    learned = new_fit(one, surface)
    fitting = Fitting(one, surface, usual(one))
    for level in levels:
        learned = fitting.run(learned, ("poses", "trans"), STEPS, InTurn({0: seen.shrunk(level)}))
    with torch.no_grad():
        error = float(
            mean_error(learned, one, surface, {0: seen}) + prior(learned, fitting.expected)
        )
    own = Rotation.from_rotvec(learned["poses"][0].detach().numpy())
    given = Rotation.from_rotvec(pose[:NUM_TURNED].numpy())
    found = pose.clone()
    found[:NUM_TURNED] = torch.from_numpy((given * own).as_rotvec()).to(found)
    return found, trans + learned["trans"][0].detach(), error


def _extrapolated(poses: Tensor, row: int) -> Tensor:
    """Return the pose (J, 3) expected in frame ``row``: that before it, turned on as it turned
    before.

    What was put on the path of headings was no motion.
    """
    if row < 2 or angle_between(poses[row - 2, 0], poses[row - 1, 0]) > OFF_COURSE:
        return poses[row - 1].clone()
    before, last = (Rotation.from_rotvec(x.numpy()) for x in (poses[row - 2], poses[row - 1]))
    on = Rotation.from_rotvec(MOMENTUM * (before.inv() * last).as_rotvec())
    return torch.from_numpy((last * on).as_rotvec()).to(poses)
