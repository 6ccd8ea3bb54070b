"""Which views of a ring of cameras are neighbours, and why two views do not suit stereo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.data.capture import View
from dyngs.data.geometry import camera_center

MIN_ANGLE, MAX_ANGLE = 5.0, 50.0
"""Degrees between the view axes of two views that suit; 45 in the paper."""
_BEST_ANGLE = 30.0  # Degrees that a pair should have that may be chosen freely
_LEVEL = 0.8  # Smallest cosine between the line from camera to camera and the rows of the images


@dataclass(frozen=True)
class Pair:
    """Indices of two views, of which ``left`` stands on the left as seen by both."""

    left: int
    right: int


def neighbours(name: str, views: Sequence[View], chosen: Sequence[int]) -> list[Pair]:
    """Return pairs of the ``chosen`` views that are next to each other on their ring, all around
    where it is closed.

    Raises DyngsError, for the capture ``name``: fewer than two views, or one without a neighbour
    that suits.
    """
    if len(chosen) < 2:
        raise DyngsError(
            f"{name}: depth comes from two neighbouring views at least, not one; give --views A,B"
        )
    ordered = around(views, chosen)
    steps = [*pairwise(ordered), *([(ordered[-1], ordered[0])] if len(ordered) > 2 else [])]
    faults = {step: fault(views[step[0]], views[step[1]]) for step in steps}
    pairs = [_pair(views, *step) for step in steps if faults[step] is None]
    alone = set(chosen) - {i for pair in pairs for i in (pair.left, pair.right)}
    for step in steps:
        if faults[step] is not None and alone.intersection(step):
            a, b = (views[i].name for i in step)
            raise DyngsError(f"{name}: {a} and {b} {faults[step]}")
    return pairs


def fault(one: View, other: View) -> str | None:
    """Return why depth cannot be found from two views, to follow their names; None: it can."""
    if one.frame != other.frame or one.time != other.time:
        return "show two moments; give views of the same one"
    apart = angle(one, other)
    if apart > MAX_ANGLE:
        return f"look from directions {apart:.0f} degrees apart; give neighbours, at most {MAX_ANGLE:g} degrees apart"
    line = camera_center(other.cam_from_world) - camera_center(one.cam_from_world)
    if apart < MIN_ANGLE or np.linalg.norm(line) == 0:
        return f"look from the same direction, {apart:.1f} degrees apart; give two at least {MIN_ANGLE:g} degrees apart"
    across = one.cam_from_world[0, :3] + other.cam_from_world[0, :3]
    if abs(line @ across) < _LEVEL * np.linalg.norm(line) * np.linalg.norm(across):
        return "do not stand side by side; give two whose images have the other camera on the left or right"
    return None


def angle(one: View, other: View) -> float:
    """Return the angle between the view axes, degrees."""
    return float(
        np.degrees(
            np.arccos(np.clip(one.cam_from_world[2, :3] @ other.cam_from_world[2, :3], -1, 1))
        )
    )


def around(views: Sequence[View], chosen: Sequence[int]) -> list[int]:
    """Return the ``chosen`` views in their order around the vertical, which is the mean of what is
    up in the images."""
    poses = np.stack([views[i].cam_from_world for i in chosen])
    up = -poses[:, 1, :3].mean(0)
    up = up / max(np.linalg.norm(up), 1e-12)
    outward = -poses[:, 2, :3]
    first = outward[0] - (outward[0] @ up) * up
    azimuth = np.arctan2(outward @ np.cross(up, first), outward @ first)
    return [chosen[i] for i in np.argsort(azimuth, kind="stable")]


def well_spread(views: Sequence[View], count: int) -> list[int]:
    """Return ``count`` views of the moment that most views show: two neighbours, or some evenly
    around the ring."""
    moments = [(view.frame, view.time) for view in views]
    same = max(dict.fromkeys(moments), key=moments.count)
    ordered = around(views, [i for i, moment in enumerate(moments) if moment == same])
    if count != 2:
        return sorted(
            {ordered[round(i * len(ordered) / count) % len(ordered)] for i in range(count)}
        )
    pairs = [(a, b) for a, b in combinations(ordered, 2) if fault(views[a], views[b]) is None]
    by_angle = sorted(
        pairs, key=lambda pair: abs(angle(views[pair[0]], views[pair[1]]) - _BEST_ANGLE)
    )
    return list(by_angle[0]) if by_angle else ordered[:2]


def lessons(views: Sequence[View]) -> list[tuple[Pair, list[int]]]:
    """Return the pairs to train on, each with the views that stand between its two, of which there
    is at least one."""
    found: list[tuple[Pair, list[int]]] = []
    for moment in dict.fromkeys((view.frame, view.time) for view in views):
        ring = around(
            views, [i for i, view in enumerate(views) if (view.frame, view.time) == moment]
        )
        for start, first in enumerate(ring):
            for step in range(2, len(ring)):
                last = ring[(start + step) % len(ring)]
                if angle(views[first], views[last]) > MAX_ANGLE:
                    break
                if fault(views[first], views[last]) is None:
                    between = [ring[(start + k) % len(ring)] for k in range(1, step)]
                    found.append((_pair(views, first, last), between))
    return found


def _pair(views: Sequence[View], one: int, other: int) -> Pair:
    line = camera_center(views[other].cam_from_world) - camera_center(views[one].cam_from_world)
    across = views[one].cam_from_world[0, :3] + views[other].cam_from_world[0, :3]
    return Pair(one, other) if line @ across > 0 else Pair(other, one)
