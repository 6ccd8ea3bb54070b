"""Checks of the poses, times and points of a capture, without its images: what spoils a training from the start."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from dyngs.capture.inspection.mask_problems import mask_problems
from dyngs.data.capture import Capture, View, all_views
from dyngs.data.geometry.focus import focus_point, fraction_in_front
from dyngs.data.geometry.poses import inverse_rigid, pose_fault
from dyngs.data.geometry.projection import projected
from dyngs.data.times import distinct_times

MAX_LINES_PER_KIND = 5
"""Problems of one kind that are listed; the others are counted."""
MAX_VIEWS = 300
"""Views, chosen at random, in which points are looked for."""
MARGIN = 0.1
"""Fractions of the image by which a point may lie outside: lenses distort."""
WIDE_BASELINE = 10.0
"""Degrees between neighbouring views, seen from the scene, from which they are far apart."""
CLOSE_IN_TIME, FEW_VIEWS = 0.08, 3
"""Motion over this fraction of a clip is small; with fewer views in it, each moment is seen from one side only."""


def before_training(capture: Capture) -> list[str]:
    """Return one line for everything about a capture that is likely to spoil a training; only some masks are read."""
    found = [*capture.warnings, *mask_problems(capture), *time_problems(capture), *scene_problems(capture)]
    return list(dict.fromkeys(found))


def time_problems(capture: Capture) -> list[str]:
    """Return the problems of times and of who saw them: a moving scene must be seen from several sides."""
    views = all_views(capture.splits)
    timed = [view for view in views if view.time is not None]
    problems = listed(
        (view for view in timed if not 0 <= (view.time or 0.0) <= 1),
        lambda view: f"'{view.name}': the time {view.time} is outside [0, 1]",
    )
    if timed and len(timed) < len(views):
        problems.append(f"{len(views) - len(timed)} of {len(views)} views have no time")
    if _is_still_monocular(capture):
        count = len(set(distinct_times(timed).values()))
        problems.append(
            f"one camera that does not move saw all {count} times: a moving scene cannot be reconstructed in 3D from "
            "that; move the camera or use several"
        )
    return problems + _ill_posed(capture)


def scene_problems(capture: Capture) -> list[str]:
    """Return the problems of poses and points together.

    Cameras that look away from the scene, points that no camera sees, cameras that see no points.
    """
    views = [view for view in all_views(capture.splits) if pose_fault(view) is None]
    if not views:
        return []
    problems = []
    poses = np.stack([inverse_rigid(view.cam_from_world) for view in views])
    centers = poses[:, :3, 3]
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    if len(poses) > 1 and spread < 1e-9 and capture.body is None and not _is_still_monocular(capture):
        problems.append("all cameras are at one place, so no depth can be found")
    xyz = capture.points.xyz if capture.points is not None else np.zeros((0, 3))
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.all():
        problems.append(f"{int((~finite).sum())} of {len(xyz)} points hold NaN or infinity")
    xyz = xyz[finite]
    focus = np.median(xyz, axis=0) if len(xyz) else focus_point(poses)
    what = "the sparse points" if len(xyz) else "each other's scene"
    if focus is not None and fraction_in_front(poses, focus) < 0.5:
        problems.append(
            f"{1 - fraction_in_front(poses, focus):.0%} of the cameras look away from {what}: are the poses in the "
            "axes that the format wants (OpenGL camera-to-world for JSON files)?"
        )
    elif focus is not None and capture.body is None:
        problems += _odd_cameras(views, focus, what)
    if len(xyz):
        problems += _point_problems(xyz, views)
    return problems


def _odd_cameras(views: list[View], center: np.ndarray, what: str) -> list[str]:
    """Few cameras that have the centre of the scene behind them, while nearly all have it in their image."""
    in_image = sum(_lies_in(center[None], view)[0] for view in views)
    local = [view.cam_from_world[2, :3] @ center + view.cam_from_world[2, 3] for view in views]
    away = [view.name for view, depth in zip(views, local, strict=True) if depth <= 0]
    if not away or in_image < 0.9 * len(views):
        return []
    return [f"{len(away)} of {len(views)} cameras look away from the centre of {what}, first '{away[0]}'"]


def _point_problems(xyz: np.ndarray, views: list[View]) -> list[str]:
    """Points outside every image and points much farther away than most, from a sample of points and views."""
    rng = np.random.default_rng(0)
    sample = xyz[rng.permutation(len(xyz))[:2000]]
    seen = np.zeros(len(sample), bool)
    blind = []
    for index in rng.permutation(len(views))[:MAX_VIEWS]:
        inside = _lies_in(sample, views[index])
        seen |= inside
        if not inside.any():
            blind.append(views[index].name)
    problems = []
    if seen.mean() < 0.9:
        problems.append(f"{1 - seen.mean():.0%} of the points are in no camera's view")
    if blind and seen.mean() >= 0.5:
        problems.append(
            f"{len(blind)} of {min(len(views), MAX_VIEWS)} cameras see none of the points, first '{min(blind)}'"
        )
    distance = np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1)
    far = distance > 50 * max(float(np.median(distance)), 1e-12)
    if far.any():
        problems.append(f"{int(far.sum())} of {len(xyz)} points lie more than 50 times farther off than the median one")
    return problems


def _lies_in(points: np.ndarray, view: View) -> np.ndarray:
    """Return (P,) whether points lie in the image or little outside."""
    places, _ = projected(points, view)
    in_front = points @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3] > 0
    return in_front & (places > -MARGIN).all(axis=1) & (places < 1 + MARGIN).all(axis=1)


def _is_still_monocular(capture: Capture) -> bool:
    """Whether a single camera that does not move took all training views, at several times."""
    views = [view for view in capture.splits.get("train", ()) if view.time is not None]
    poses = {view.cam_from_world.round(9).tobytes() for view in views}
    return capture.body is None and len(poses) == 1 and len(set(distinct_times(views).values())) > 1


def _ill_posed(capture: Capture) -> list[str]:
    """Few images of one time each from places far apart: what moves has moved on before another side of it is seen.

    Many such images are no problem (D-NeRF's are all like that): neighbours in time then show nearly the same moment.
    """
    views = sorted((v for v in capture.splits.get("train", ()) if v.time is not None), key=lambda v: v.time or 0.0)
    times = set(distinct_times(views).values())
    if capture.body is not None or not 3 <= len(views) == len(times) or len(times) * CLOSE_IN_TIME >= FEW_VIEWS:
        return []
    poses = np.stack([inverse_rigid(view.cam_from_world) for view in views])
    center = focus_point(poses) if capture.points is None else np.median(capture.points.xyz, axis=0)
    if center is None or not np.isfinite(center).all():
        return []
    offsets = poses[:, :3, 3] - center
    directions = offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12)
    angles = np.degrees(np.arccos(np.clip((directions[1:] * directions[:-1]).sum(axis=1), -1, 1)))
    if angles.mean() < WIDE_BASELINE:
        return []
    return [
        f"{len(views)} images, each at a time of its own, {angles.mean():.0f} degrees apart on average: what moves "
        "is seen from one side only at each time; expect a still result"
    ]


def listed(items: Iterable[Any], line: Callable[[Any], str]) -> list[str]:
    """Return one line per item, and a count of those beyond ``MAX_LINES_PER_KIND``."""
    lines = [line(item) for item in items]
    if len(lines) <= MAX_LINES_PER_KIND:
        return lines
    return [*lines[:MAX_LINES_PER_KIND], f"... and {len(lines) - MAX_LINES_PER_KIND} more like the last one"]
