"""Where motion begins before cameras that stand still: at what travels, already on its way.

Local letters: S nodes, M moving Gaussians, P control points of a spline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.deform.fixed_cameras.changes import Footage
from dyngs.deform.fixed_cameras.hulls import blobs_in, silhouettes_at
from dyngs.deform.fixed_cameras.linking import Track, linked
from dyngs.deform.fixed_cameras.seeds import Moment, Seeds, fitted, moments_of, num_cubes, pays, pieces_for, seeds_of
from dyngs.deform.nodes import spread_out
from dyngs.deform.random_gaussians import box_of
from dyngs.gaussians import Gaussians

ROOM = 0.25  # Room around the things that stand still and the cameras, in sides of their box
LEAST_SHOWN = 0.05
"""Least area that a thing shows over its times, as a fraction of that of the largest: less is noise at things in
place."""
MAX_TRACKS = 24
NODES_PER_TRACK = 40
NODE_FRACTION = 0.5  # Nodes on things that are tracked, as a fraction of all, at most


@dataclass(frozen=True)
class FirstMotion:
    """Things that travel, as Gaussians and paths."""

    seeds: tuple[Seeds, ...] = ()
    finding: str | None = None

    @property
    def gaussians(self) -> list[Gaussians]:
        return [one.gaussians for one in self.seeds]

    def nodes(self, others: Tensor, most: int, pieces: range) -> tuple[Tensor, Tensor]:
        """Return (S, 3) nodes and the (S, P, 3) control points of their paths.

        Those on one thing share its path; those among ``others`` stand still.
        """
        tracks = [one.track for one in self.seeds]
        num_pieces = pieces_for(tracks, pieces)
        none = torch.zeros(0, 3, device=others.device)
        fraction = max(1, min(NODES_PER_TRACK, int(NODE_FRACTION * most / len(tracks))))
        places, paths = [], []
        for one in self.seeds:
            means = one.gaussians.means
            places.append(means[spread_out(means, fraction, none)])
            path = fitted(one.track, num_pieces) - torch.from_numpy(one.center).float()
            paths.append(path.expand(len(places[-1]), -1, -1))
        own = torch.cat(places)
        still = others[spread_out(others, max(most - len(own), 0), own)]
        return torch.cat([own, still]), torch.cat(
            [*paths, torch.zeros(len(still), *paths[0].shape[1:], device=own.device)]
        )


def first_motion(
    footage: Sequence[Footage], still: Gaussians, moving: Tensor, extent: float, limit: int
) -> FirstMotion:
    """Return what travels before the cameras of ``frames``, where ``still`` Gaussians are or the cameras look."""
    if len(footage) < 2 or limit < 1:
        return FirstMotion()
    tracks = found_tracks(footage, *_box(footage, still, extent))
    if not tracks:
        return FirstMotion()
    shown = [track.travels * len(track.times) * track.radius**2 for track in tracks]
    travelling = [t for t, area in zip(tracks, shown, strict=True) if area > LEAST_SHOWN * max(shown)][:MAX_TRACKS]
    seeds: list[Seeds] = []
    others = still.means[moving].double().cpu().numpy()
    for track in travelling:
        one = seeds_of(track, footage, limit // max(len(travelling), 1), still.sh.shape[1], others)
        if pays(one, footage):
            seeds.append(one)
            others = np.concatenate([others, one.gaussians.means.double().cpu().numpy()])
    if not seeds:
        return FirstMotion()
    total = len({time for one in footage for time in one.times})
    lengths = ", ".join(str(len(one.track.times)) for one in seeds)
    count = sum(len(one.gaussians) for one in seeds)
    things = "1 thing travels" if len(seeds) == 1 else f"{len(seeds)} things travel"
    finding = f"{things} before the fixed cameras, found at {lengths} of {total} times: {count} Gaussians begin there"
    return FirstMotion(tuple(seeds), finding)


def moments(footage: Sequence[Footage], still: Gaussians, extent: float, limit: int) -> list[Moment]:
    if len(footage) < 2 or limit < 1:
        return []
    low, high = _box(footage, still, extent)
    times = sorted({time for one in footage for time in one.times})
    tracks = linked(times, [blobs_in(silhouettes_at(footage, time), low, high) for time in times])
    total = sum(map(num_cubes, tracks))
    found = []
    for t in tracks:
        m = moments_of(t, footage, max(total / limit, 1.0), still.sh.shape[1])
        print("track", len(t.times), "travels", t.travels, "radius", t.radius, "cubes", num_cubes(t)/len(t.times), "kept", len(m), t.centers.mean(0))
        found += m
    return found


def found_tracks(footage: Sequence[Footage], low: np.ndarray, high: np.ndarray) -> list[Track]:
    """Return the tracks of all that moves in the box from ``low`` to ``high`` (3,), longest first."""
    times = sorted({time for one in footage for time in one.times})
    return linked(times, [blobs_in(silhouettes_at(footage, time), low, high) for time in times])


def _box(footage: Sequence[Footage], still: Gaussians, extent: float) -> tuple[np.ndarray, np.ndarray]:
    """Return two corners (3,) of a box with the still things and the cameras, and some room around."""
    center, half_size = (x.double().cpu().numpy() for x in box_of(still, extent))
    centers = np.concatenate([one.camera.centers.double().cpu().numpy() for one in footage])
    low, high = np.minimum(center - half_size, centers.min(0)), np.maximum(center + half_size, centers.max(0))
    room = ROOM * (high - low).max()
    return low - room, high + room
