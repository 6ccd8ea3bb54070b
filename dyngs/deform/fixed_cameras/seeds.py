"""Gaussians to begin motion with, on what fixed cameras see to change at a time.

Local letters: L times of a track, S seeds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.core.conventions import SH_C0
from dyngs.deform.fixed_cameras.changes import Footage
from dyngs.deform.fixed_cameras.hulls import silhouettes_at
from dyngs.deform.fixed_cameras.linking import Track
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import render

USUAL_FRACTION = 0.4
"""Fraction of the times at which a cube of a thing's own frame lies in its hull, for it to belong
to the thing."""
WHOLE = 0.75  # Fraction of the usual radius from which a hull shows the whole thing
SCALE = 0.6  # Standard deviation of a seed in distances between seeds
LOGIT = 1.4  # Opacity 0.8: where a hull is, something is
PAYS = 0.9  # Fraction of the medians' squared error that may be left where seeds cover an image
SHOWN = 0.4
"""Fraction of the pixels that seeds cover in which an image must change; else something still hides
the thing; and of images that are not so."""
COVERED = 0.1  # Opacity from which they cover a pixel


@dataclass(frozen=True)
class Moment:
    """Gaussians that are there at one time."""

    time: float
    gaussians: Gaussians
    velocity: Tensor  # (3,) world units per clip


def moments_of(
    track: Track, footage: Sequence[Footage], thinned: float, num_terms: int
) -> list[Moment]:
    """Return Gaussians on the surface of what ``track`` follows, one for ``thinned`` of its cubes,
    for each time.

    Each has the mean of its colours in the images of its time in which it is on the side of the
    camera and the image changes there. What travels has the surface of the cubes, in its own frame,
    which lie in its hulls at many times; other things have that of the hull of the time. Times are
    left out at which the Gaussians do not pay.
    """
    usual = surface(track)
    pace = np.gradient(track.centers, np.array(track.times), axis=0)
    found: list[Moment] = []
    for time, blob, velocity in zip(track.times, track.blobs, pace, strict=True):
        here = Track((time,), (blob,))
        points, side = usual if track.travels else surface(here)
        dense = _on_surface(points, side, here, footage, num_terms)
        if pays(dense, time, footage):
            gaussians = _thinned(dense, max(round(len(points) / thinned), 1))
            found.append(
                Moment(time, gaussians, torch.from_numpy(velocity * track.travels).float())
            )
    return found


def _thinned(gaussians: Gaussians, count: int) -> Gaussians:
    """Return ``count`` of the Gaussians, evenly chosen, so much larger that they cover as much."""
    rows = torch.linspace(0, len(gaussians) - 1, count, device="cpu").round().long()
    kept = gaussians.select(rows)
    return kept.replace(log_scales=kept.log_scales + 0.5 * math.log(len(gaussians) / count))


def pays(gaussians: Gaussians, time: float, footage: Sequence[Footage]) -> bool:
    """Return whether ``gaussians``, drawn over the cameras' medians, are nearer to the images of
    ``time`` than these.

    Over the pixels that they cover, in the images in which the thing is not hidden. A false hull,
    where silhouettes of different things cross, does not pay.
    """
    before = after = 0.0
    looked_at = shown = 0
    for one in (one for one in footage if time in one.times):
        i = one.times.index(time)
        with torch.no_grad():
            drawn = render(gaussians, one.camera)
        alpha = drawn.alpha[0].reshape(*one.changed.shape[1:], 1)
        covered = (alpha[..., 0] > COVERED) & torch.from_numpy(one.counted[i])
        if not bool(covered.any()):
            continue
        looked_at += 1
        if float(torch.from_numpy(one.changed[i])[covered].float().mean()) < SHOWN:
            continue
        shown += 1
        truth, still = (torch.from_numpy(x).float() / 255 for x in (one.images[i], one.median))
        before += float((still - truth).square().sum(-1)[covered].sum())
        after += float((drawn.rgb[0] + (1 - alpha) * still - truth).square().sum(-1)[covered].sum())
    return shown >= SHOWN * looked_at and after < PAYS * before


def surface(track: Track) -> tuple[np.ndarray, float]:
    """Return (S, 3) points on the surface of a thing, from its centre, and the distance between
    them."""
    whole = [blob for blob in track.blobs if blob.radius >= WHOLE * track.radius]
    side = float(np.median([blob.side for blob in whole]))
    cells: dict[tuple[int, ...], int] = {}
    for blob in whole:
        for cell in np.unique(
            np.round((blob.cubes - blob.center) / side).astype(int), axis=0
        ).tolist():
            cells[tuple(cell)] = cells.get(tuple(cell), 0) + 1
    kept = {cell for cell, count in cells.items() if count >= USUAL_FRACTION * len(whole)} or set(
        cells
    )
    steps = [(0, 0, 1), (0, 0, -1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0)]
    inner = {c for c in kept if all((c[0] + x, c[1] + y, c[2] + z) in kept for x, y, z in steps)}
    return np.array(sorted(kept - inner), float) * side, side


def _on_surface(
    points: np.ndarray, side: float, here: Track, footage: Sequence[Footage], num_terms: int
) -> Gaussians:
    count = len(points)
    sh = torch.zeros(len(points), num_terms, 3, device="cpu")
    sh[:, 0] = torch.from_numpy((_colors(points, here, footage) - 0.5) / SH_C0).float()
    return Gaussians(
        means=torch.from_numpy(points + here.centers[0]).float(),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], device="cpu").repeat(count, 1),
        log_scales=torch.full((count, 3), math.log(SCALE * side), device="cpu"),
        logit_opacities=torch.full((count,), LOGIT, device="cpu"),
        sh=sh,
    )


def _colors(points: np.ndarray, track: Track, footage: Sequence[Footage]) -> np.ndarray:
    total = np.zeros((len(points), 3))
    count = np.zeros((len(points), 1))
    outward = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-9)
    for time, center in zip(track.times, track.centers, strict=True):
        for view in silhouettes_at(footage, time):
            towards = view.center - (center + points)
            faces = (outward * towards).sum(1) > 0.3 * np.linalg.norm(towards, axis=1)
            _, shown = view.seen(center + points)
            rows = np.flatnonzero(faces & shown)
            if len(rows):
                x, y = np.floor(view.pixels((center + points)[rows])[0]).astype(int).T
                total[rows] += view.image[y, x] / 255
                count[rows] += 1
    usual = total.sum(0) / max(count.sum(), 1)
    return np.where(count > 0, total / np.maximum(count, 1), usual)
