"""Triangulation of 2D key points that several calibrated cameras show at the same time.

Symbols: V views of one frame, J = 55 joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from dyngs.data.body_frames import frame_number
from dyngs.data.capture import View
from dyngs.human.fit.keypoints import MIN_CONFIDENCE, Joints3D, Keypoints, RelativeJoints

TOLERANCE = 0.05  # reprojection error of an inlier, in heights of the person in that view
TWO_VIEW_CONFIDENCE = 0.5  # factor for joints that only two cameras confirm


def triangulate_joints(views: Sequence[View], keypoints: Keypoints) -> Joints3D:
    """Triangulate the joints of all frames that at least two views show.

    Each joint is intersected from all pairs of views; the pair that most other views agree with
    gives the inliers, from which the position is computed again (RANSAC without sampling).

    Args:
        views: with frame numbers.
        keypoints: undistorted, by view name.

    Returns:
        Positions (J, 4) in world coordinates with confidence by frame number; only of frames with
        a triangulated joint.
    """
    by_frame: dict[int, list[View]] = {}
    for view in views:
        if view.name in keypoints:
            by_frame.setdefault(frame_number(view), []).append(view)
    joints: Joints3D = {}
    for frame, group in by_frame.items():
        points = np.stack([keypoints[view.name].double().numpy() for view in group])  # (V, J, 3)
        projections = np.stack(
            [view.intrinsics @ view.cam_from_world[:3].astype(np.float64) for view in group]
        )
        tolerances = np.array([TOLERANCE * person_height(one) for one in points])
        placed = np.zeros((points.shape[1], 4))
        for joint in np.flatnonzero((points[..., 2] > MIN_CONFIDENCE).sum(0) >= 2):
            placed[joint] = _triangulate(projections, points[:, joint], tolerances)
        if placed[:, 3].any():
            joints[frame] = torch.from_numpy(placed).float()
    return joints


def orient_relative_joints(
    views: Sequence[View], keypoints: Keypoints, relative: RelativeJoints
) -> Joints3D:
    """Return estimated joints (J, 4) relative to the hips in axes of the world, by frame number.

    The axes of an estimate are those of a camera that looks at the person, so that they are turned
    to the direction of the key points. The most confident view of each frame is used.

    Args:
        views: with frame numbers.
        keypoints: undistorted, by view name.
        relative: in axes of the camera, by view name.
    """
    best: dict[int, View] = {}
    for view in views:
        if view.name in keypoints and view.name in relative:
            frame = frame_number(view)
            other = best.get(frame, view)
            if keypoints[view.name][:, 2].sum() >= keypoints[other.name][:, 2].sum():
                best[frame] = view
    joints: Joints3D = {}
    for frame, view in best.items():
        points = keypoints[view.name].double().numpy()
        middle = np.average(points[:, :2], axis=0, weights=points[:, 2] + 1e-9)
        ray = np.linalg.solve(view.intrinsics, np.append(middle, 1.0))
        to_camera = Rotation.align_vectors(ray[None], np.array([[0.0, 0.0, 1.0]]))[0]
        to_world = view.cam_from_world[:3, :3].T @ to_camera.as_matrix()
        placed = relative[view.name].clone()
        placed[:, :3] = placed[:, :3] @ torch.from_numpy(to_world).to(placed).T
        joints[frame] = placed
    return joints


def person_height(points: np.ndarray) -> float:
    """Return the vertical extent, px, of the confident key points (J, 3) of one view."""
    rows = points[points[:, 2] > MIN_CONFIDENCE, 1]
    return max(float(np.ptp(rows)), 1.0) if len(rows) else 1.0


def _triangulate(projections: np.ndarray, points: np.ndarray, tolerances: np.ndarray) -> np.ndarray:
    """Return position and confidence (4,) of one joint; zeros if no two views agree.

    Args:
        projections: (V, 3, 4) from world coordinates to pixels.
        points: (V, 3) column, row, px, and confidence.
        tolerances: (V,) largest reprojection error of an inlier, px.
    """
    seen = np.flatnonzero(points[:, 2] > MIN_CONFIDENCE)
    best = np.zeros(0, np.int64)
    for pair in combinations(seen, 2):
        position = _intersect(projections[list(pair)], points[list(pair)])
        is_inlier = (
            _reprojection_errors(projections[seen], points[seen], position) < (tolerances[seen])
        )
        if not np.isin(pair, seen[is_inlier]).all():
            continue
        if points[seen[is_inlier], 2].sum() > points[best, 2].sum():
            best = seen[is_inlier]
    if len(best) < 2:
        return np.zeros(4)
    position = _intersect(projections[best], points[best])
    confidence = points[best, 2].mean() * (TWO_VIEW_CONFIDENCE if len(best) == 2 else 1.0)
    return np.append(position, confidence)


def _intersect(projections: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the point (3,) nearest to the rays of V views (linear triangulation, weighted by
    confidence)."""
    rows = points[:, :2, None] * projections[:, 2:] - projections[:, :2]  # (V, 2, 4)
    rows = rows / np.linalg.norm(rows[..., :3], axis=-1, keepdims=True)
    rows = (rows * points[:, 2, None, None]).reshape(-1, 4)
    solution = np.linalg.svd(rows)[2][-1]
    return solution[:3] / (solution[3] if abs(solution[3]) > 1e-12 else 1e-12)


def _reprojection_errors(
    projections: np.ndarray, points: np.ndarray, position: np.ndarray
) -> np.ndarray:
    """Return the distances (V,) in px; infinity behind a camera."""
    local = projections @ np.append(position, 1.0)
    distance = np.linalg.norm(local[:, :2] / local[:, 2:] - points[:, :2], axis=1)
    return np.where(local[:, 2] > 0, distance, np.inf)
