"""Where motion begins before cameras that stand still: at what they see to change, at each time
anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dyngs.deform.fixed_cameras.changes import Footage
from dyngs.deform.fixed_cameras.hulls import blobs_in, silhouettes_at
from dyngs.deform.fixed_cameras.linking import Track, linked
from dyngs.deform.fixed_cameras.seeds import Moment, moments_of, surface
from dyngs.deform.fixed_cameras.surfaces import surface_changes
from dyngs.deform.random_gaussians import box_of
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions

ROOM = 0.25  # Room around the things that stand still and the cameras, in sides of their box


@dataclass(frozen=True)
class FirstMotion:
    """What changes, as Gaussians at single times."""

    moments: tuple[Moment, ...] = ()
    finding: str | None = None


def first_motion(
    footage: Sequence[Footage], still: Gaussians, extent: float, limit: int, options: RenderOptions
) -> FirstMotion:
    """Return what changes before the cameras of ``footage``, where ``still`` Gaussians are or the
    cameras look.

    At most about ``limit`` Gaussians on things, and as many on still surfaces that look different
    at times.
    """
    if len(footage) < 2 or limit < 1:
        return FirstMotion()
    tracks = found_tracks(footage, *_box(footage, still, extent))
    cubes = sum(len(surface(track)[0]) * len(track.times) for track in tracks)
    thinned = max(cubes / limit, 1.0)
    num_terms = still.sh.shape[1]
    things = [
        moments
        for moments in (moments_of(x, footage, thinned, num_terms) for x in tracks)
        if moments
    ]
    shades = surface_changes(footage, still, options, limit)
    moments = tuple(moment for group in (*things, shades) for moment in group)
    if not moments:
        return FirstMotion()
    total = len(_times(footage))
    count = sum(len(one.gaussians) for one in moments)
    lengths = ", ".join(str(len(one)) for one in things)
    what = f"things that move found at {lengths} of {total} times" if things else "surfaces change"
    return FirstMotion(moments, f"{what} before the fixed cameras: {count:,} Gaussians begin there")


def found_tracks(footage: Sequence[Footage], low: np.ndarray, high: np.ndarray) -> list[Track]:
    """Return the tracks of all that moves in the box from ``low`` to ``high`` (3,), longest
    first."""
    times = _times(footage)
    return linked(times, [blobs_in(silhouettes_at(footage, time), low, high) for time in times])


def _box(
    footage: Sequence[Footage], still: Gaussians, extent: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return two corners (3,) of a box with the still things and the cameras, and some room
    around."""
    center, half_size = (x.double().cpu().numpy() for x in box_of(still, extent))
    centers = np.concatenate([one.camera.centers.double().cpu().numpy() for one in footage])
    low = np.minimum(center - half_size, centers.min(0))
    high = np.maximum(center + half_size, centers.max(0))
    room = ROOM * (high - low).max()
    return low - room, high + room


def _times(footage: Sequence[Footage]) -> list[float]:
    return sorted({time for one in footage for time in one.times})
