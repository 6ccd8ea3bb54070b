"""Refinement of the poses of fixed cameras from key points of a person (bundle adjustment).

Symbols: C cameras, P triangulated joints, O observations of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix
from scipy.spatial.transform import Rotation

from dyngs.data.body_frames import frame_number
from dyngs.data.capture import View
from dyngs.human.fit.keypoints import MIN_CONFIDENCE, Keypoints
from dyngs.human.fit.triangulation import person_height, triangulate_joints

MIN_CAMERAS = 3  # two cameras do not tell their own error from that of the key points
MIN_JOINTS = 100  # triangulated joints of the fitted frames
HELD_OUT = 4  # every fourth frame is left out of the fit and decides
MIN_GAIN = 0.1  # least decrease of the reprojection error, as a fraction, on these frames
ROTATION_STD = np.radians(1.0)  # expected error of given poses
POSITION_STD = 0.02  # expected error of given positions, as a fraction of the mean distance
NOISE = 0.01  # reprojection error from which key points are outliers, in heights of the person


@dataclass(frozen=True)
class CameraRefinement:
    """Refined poses, and the median reprojection error, px, on frames that were left out."""

    poses: dict[int, np.ndarray]  # (4, 4) cam_from_world by camera
    before: float
    after: float

    def apply(self, views: Sequence[View]) -> tuple[View, ...]:
        """Return the views with refined poses."""
        return tuple(
            replace(view, cam_from_world=self.poses.get(view.camera_id, view.cam_from_world))
            for view in views
        )

    def summary(self) -> str:
        """Return a one-line summary."""
        return (
            "cameras refined by key points: median reprojection error of joints "
            f"{self.before:.1f} -> {self.after:.1f} px on frames left out"
        )


def refine_cameras(views: Sequence[View], keypoints: Keypoints) -> CameraRefinement | None:
    """Refine the poses of three or more fixed cameras by the key points of the person they show.

    Joints are triangulated; rotation and position of each camera are optimised together with them,
    near the given poses. Intrinsics are kept. Returns None for other captures, too few joints, and
    where frames that were left out do not agree better afterwards.

    Args:
        views: with frame numbers.
        keypoints: undistorted, by view name.
    """
    groups: dict[int, list[View]] = {}
    for view in views:
        if view.name in keypoints:
            groups.setdefault(view.camera_id, []).append(view)
    is_fixed = all(
        np.allclose(view.cam_from_world, group[0].cam_from_world, atol=1e-6)
        for group in groups.values()
        for view in group
    )
    if len(groups) < MIN_CAMERAS or not is_fixed:
        return None
    order = {frame: i for i, frame in enumerate(sorted({frame_number(view) for view in views}))}
    held_out = [v for v in views if order[frame_number(v)] % HELD_OUT == HELD_OUT // 2]
    fitted = [v for v in views if order[frame_number(v)] % HELD_OUT != HELD_OUT // 2]
    poses = _bundle_adjust(fitted, keypoints)
    if poses is None:
        return None
    before = _median_error(held_out, keypoints)
    result = CameraRefinement(poses, before, 0.0)
    after = _median_error(result.apply(held_out), keypoints)
    if not after < (1 - MIN_GAIN) * before:
        return None
    return replace(result, after=after)


def _median_error(views: Sequence[View], keypoints: Keypoints) -> float:
    """Return the median distance, px, of key points from their triangulated joints."""
    joints = triangulate_joints(views, keypoints)
    errors = [np.zeros(0)]
    for view in views:
        if view.name in keypoints and frame_number(view) in joints:
            placed = joints[frame_number(view)].double().numpy()
            points = keypoints[view.name].double().numpy()
            used = (placed[:, 3] > 0) & (points[:, 2] > MIN_CONFIDENCE)
            local = placed[used, :3] @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
            pixels = local @ view.intrinsics.T
            places = pixels[:, :2] / pixels[:, 2:]
            errors.append(np.linalg.norm(places - points[used, :2], axis=1))
    everything = np.concatenate(errors)
    return float(np.median(everything)) if len(everything) else float("inf")


def _bundle_adjust(views: Sequence[View], keypoints: Keypoints) -> dict[int, np.ndarray] | None:
    """Return refined poses (4, 4) by camera; None: too few joints."""
    joints = triangulate_joints(views, keypoints)
    numbers = sorted({view.camera_id for view in views})
    first = {number: next(v for v in views if v.camera_id == number) for number in numbers}
    places: dict[tuple[int, int], int] = {}
    start: list[np.ndarray] = []
    rows: list[tuple[int, int, np.ndarray, float]] = []  # camera, joint, key point, tolerance
    for view in views:
        if view.name not in keypoints or frame_number(view) not in joints:
            continue
        frame = frame_number(view)
        points = keypoints[view.name].double().numpy()
        tolerance = NOISE * person_height(points)
        placed = joints[frame].double().numpy()
        for joint in np.flatnonzero((placed[:, 3] > 0) & (points[:, 2] > MIN_CONFIDENCE)):
            key = (frame, int(joint))
            if key not in places:
                places[key] = len(start)
                start.append(placed[joint, :3])
            camera = numbers.index(view.camera_id)
            rows.append((camera, places[key], points[joint], tolerance))
    if len(start) < MIN_JOINTS:
        return None
    cameras, indices = (np.array([row[i] for row in rows]) for i in (0, 1))
    points = np.stack([row[2] for row in rows])
    weights = np.sqrt(points[:, 2]) / np.array([row[3] for row in rows])
    rotations = np.stack([first[number].cam_from_world[:3, :3] for number in numbers])
    translations = np.stack([first[number].cam_from_world[:3, 3] for number in numbers])
    intrinsics = np.stack([first[number].intrinsics for number in numbers])
    centre = np.mean(start, axis=0)
    distance = float(np.linalg.norm(rotations @ centre + translations, axis=1).mean())
    units = np.tile(np.repeat([ROTATION_STD, POSITION_STD * distance], 3), (len(numbers), 1))

    def corrected(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rotations (C, 3, 3) and translations (C, 3); cameras turn about the middle of the
        joints, so that their two corrections are independent."""
        corrections = values[: units.size].reshape(units.shape) * units
        turns = Rotation.from_rotvec(corrections[:, :3]).as_matrix()
        middle = rotations @ centre + translations
        moved = (turns @ (translations - middle)[..., None])[..., 0] + middle
        return turns @ rotations, moved + corrections[:, 3:]

    def residuals(values: np.ndarray) -> np.ndarray:
        turned, moved = corrected(values)
        joints = values[units.size :].reshape(-1, 3) + np.array(start)
        local = (turned[cameras] @ joints[indices][..., None])[..., 0] + moved[cameras]
        pixels = (intrinsics[cameras] @ local[..., None])[..., 0]
        errors = weights[:, None] * (pixels[:, :2] / pixels[:, 2:] - points[:, :2])
        return np.concatenate([errors.ravel(), values[: units.size]])

    sparsity = lil_matrix((2 * len(rows) + units.size, units.size + 3 * len(start)), dtype=np.int8)
    for row, (camera, index) in enumerate(zip(cameras, indices, strict=True)):
        sparsity[2 * row : 2 * row + 2, 6 * camera : 6 * camera + 6] = 1
        column = units.size + 3 * index
        sparsity[2 * row : 2 * row + 2, column : column + 3] = 1
    for i in range(units.size):
        sparsity[2 * len(rows) + i, i] = 1
    solution = least_squares(
        residuals,
        np.zeros(units.size + 3 * len(start)),
        jac_sparsity=sparsity,
        loss="soft_l1",
        x_scale=np.concatenate([np.ones(units.size), np.full(3 * len(start), 0.01 * distance)]),
        max_nfev=40,
    )
    turned, moved = corrected(solution.x)
    poses = {}
    for number, rotation, translation in zip(numbers, turned, moved, strict=True):
        poses[number] = np.eye(4)
        poses[number][:3, :3] = rotation
        poses[number][:3, 3] = translation
    return poses
