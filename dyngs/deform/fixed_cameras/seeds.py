"""Gaussians and splines to begin motion with, from tracks.

Local letters: L times of a track, S seeds, K of its nodes, P control points of a spline.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.conventions import SH_C0
from dyngs.deform.fixed_cameras.changes import Footage
from dyngs.deform.fixed_cameras.hulls import silhouettes_at
from dyngs.deform.fixed_cameras.linking import Track
from dyngs.deform.spline_fit import SPAN, cubic_fractions
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import render

USUAL_FRACTION = 0.4
"""Fraction of the times at which a cube of a thing's own frame lies in its hull, for it to belong to the thing."""
WHOLE = 0.75  # Fraction of the usual radius from which a hull shows the whole thing
SCALE = 0.6  # Standard deviation of a seed in distances between seeds
THINNED, FEWEST = 4, 100
"""One seed for so many cubes of a surface, that is for some four pixels, but not fewer for a thing, if it has them."""
LOGIT = 1.4  # Opacity 0.8: where a hull is, something is
FIT = 0.1  # Mean error of a spline, in radii of the thing, that is small enough
BEND = 1e-4
"""Weight of squared second differences in a fit: it decides where a track has gaps, and straight on at its ends."""
APART = 3.0  # Radii from the centre of a thing within which others are near
PAYS = 0.9  # Fraction of the medians' squared error that may be left where seeds cover an image
SHOWN = 0.4
"""Fraction of the pixels that seeds cover in which an image must change; else something still hides the thing;
and of images that are not so."""
JUDGED_TIMES = 8  # Times at which seeds are compared with the images
COVERED = 0.1  # Opacity from which they cover a pixel


@dataclass(frozen=True)
class Seeds:
    """Gaussians of one thing at the time ``time``, and how it moves from there."""

    track: Track
    time: float
    gaussians: Gaussians

    @property
    def center(self) -> np.ndarray:
        return self.track.centers[self.track.times.index(self.time)]

    def placed(self, index: int) -> Gaussians:
        shift = self.track.centers[index] - self.center
        return self.gaussians.replace(means=self.gaussians.means + torch.from_numpy(shift).float())


def seeds_of(track: Track, footage: Sequence[Footage], limit: int, num_terms: int, others: np.ndarray) -> Seeds:
    """Return at most ``limit`` Gaussians on the surface of what ``track`` follows, coloured from the images.

    The surface is that of the cubes, in the thing's own frame, which lie in its hulls at many times; the colour of a
    seed is the mean over all images in which it is on the side of the camera and the image changes there.

    Args:
        others: (M, 3) other things that move: the Gaussians begin where the track is apart from them, so that none
            follows the nodes of another thing.
    """
    points, side = _surface(track)
    count = min(limit, max(len(points) // THINNED, FEWEST))
    if count < len(points):
        side *= math.sqrt(len(points) / count)
        points = points[np.linspace(0, len(points) - 1, count).round().astype(int)]
    colors, _ = _colors(points, track, footage)
    begin = _apart(track, others)
    count = len(points)
    sh = torch.zeros(count, num_terms, 3, device="cpu")
    sh[:, 0] = torch.from_numpy((colors - 0.5) / SH_C0).float()
    gaussians = Gaussians(
        means=torch.from_numpy(points + track.centers[begin]).float(),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], device="cpu").repeat(count, 1),
        log_scales=torch.full((count, 3), math.log(SCALE * side), device="cpu"),
        logit_opacities=torch.full((count,), LOGIT, device="cpu"),
        sh=sh,
    )
    return Seeds(track, track.times[begin], gaussians)


@dataclass(frozen=True)
class Moment:
    """Gaussians on one thing at one time, and its velocity then."""

    time: float
    gaussians: Gaussians
    velocity: np.ndarray  # (3,) world units per clip


def moments_of(track: Track, footage: Sequence[Footage], thinned: float, num_terms: int) -> list[Moment]:
    """Return Gaussians on the surface of what ``track`` follows, one for ``thinned`` of its cubes, for each of its times.

    Each has the mean of its colours in the images of its time; of all times, where none shows it then. What travels has
    the surface that is usual over time; of other things it is that of the hull of a time. Left out are times at which
    the Gaussians, drawn over the cameras' medians, are not nearer to the images than the medians alone.
    """
    usual, side = _surface(track)
    pace = np.gradient(track.centers, np.array(track.times), axis=0) if len(track.times) > 1 else np.zeros((1, 3))
    found: list[Moment] = []
    for time, blob, velocity in zip(track.times, track.blobs, pace, strict=True):
        here = Track((time,), (blob,))
        points, size = (usual, side) if track.travels else _surface(here)
        rows = np.linspace(0, len(points) - 1, max(round(len(points) / thinned), 1)).round().astype(int)
        points, size = points[rows], size * math.sqrt(len(points) / len(rows))
        colors, _ = _colors(points, here, footage)
        gaussians = _on_surface(points + blob.center, size, colors, num_terms)
        if _pays_at(time, gaussians, footage):
            found.append(Moment(time, gaussians, velocity * track.travels))
    return found


def num_cubes(track: Track) -> int:
    return len(_surface(track)[0]) * len(track.times)


def _on_surface(points: np.ndarray, side: float, colors: np.ndarray, num_terms: int) -> Gaussians:
    count = len(points)
    sh = torch.zeros(count, num_terms, 3, device="cpu")
    sh[:, 0] = torch.from_numpy((colors - 0.5) / SH_C0).float()
    return Gaussians(
        means=torch.from_numpy(points).float(),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], device="cpu").repeat(count, 1),
        log_scales=torch.full((count, 3), math.log(SCALE * side), device="cpu"),
        logit_opacities=torch.full((count,), LOGIT, device="cpu"),
        sh=sh,
    )


def _pays_at(time: float, gaussians: Gaussians, footage: Sequence[Footage]) -> bool:
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


def pays(seeds: Seeds, footage: Sequence[Footage]) -> bool:
    """Return whether ``seeds``, drawn over the cameras' medians, are nearer to the images than the medians alone.

    Over the pixels that the seeds cover, at some times of the track, in the images in which the thing is not hidden.
    A false hull, where silhouettes of different things cross, does not pay.
    """
    before = after = 0.0
    looked_at = shown = 0
    for index in np.unique(np.linspace(0, len(seeds.track.times) - 1, JUDGED_TIMES).round().astype(int)):
        gaussians, time = seeds.placed(int(index)), seeds.track.times[index]
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


def pieces_for(tracks: Sequence[Track], pieces: range) -> int:
    """Return the least number of ``pieces`` with which splines fit all ``tracks``, the largest if none does.

    They fit where the mean error over a track's times is below ``FIT`` of its radius.
    """
    for count in pieces:
        if all(_misfit(track, fitted(track, count)) < FIT * track.radius for track in tracks):
            return count
    return pieces[-1]


def fitted(track: Track, pieces: int) -> Tensor:
    """Return the (P, 3) control points of the spline of ``pieces`` that is nearest to the places of ``track``."""
    basis = _basis(track.times, pieces)
    bends = np.diff(np.eye(pieces + SPAN - 1), n=2, axis=0) * math.sqrt(BEND)
    left = np.concatenate([basis, bends])
    right = np.concatenate([track.centers, np.zeros((len(bends), 3))])
    return torch.from_numpy(np.linalg.lstsq(left, right, rcond=None)[0]).float()


def _misfit(track: Track, points: Tensor) -> float:
    basis = _basis(track.times, len(points) - SPAN + 1)
    return float(np.linalg.norm(basis @ points.double().cpu().numpy() - track.centers, axis=1).mean())


def _basis(times: Sequence[float], pieces: int) -> np.ndarray:
    basis = np.zeros((len(times), pieces + SPAN - 1))
    for row, time in enumerate(times):
        piece = min(int(time * pieces), pieces - 1)
        basis[row, piece : piece + SPAN] = cubic_fractions(time * pieces - piece).cpu().numpy()
    return basis


def _apart(track: Track, others: np.ndarray) -> int:
    """Return the index of the time, near the middle, at which nothing of ``others`` (M, 3) is near, or least so."""
    from_middle = sorted(range(len(track.times)), key=lambda i: abs(i - (len(track.times) - 1) / 2))
    if not len(others):
        return from_middle[0]
    gaps = [float(np.linalg.norm(others - track.centers[i], axis=1).min()) for i in from_middle]
    return from_middle[int(np.argmax(np.minimum(gaps, APART * track.radius)))]


def _surface(track: Track) -> tuple[np.ndarray, float]:
    """Return (S, 3) points on the surface of a thing, from its centre, and the distance between them."""
    whole = [blob for blob in track.blobs if blob.radius >= WHOLE * track.radius]
    side = float(np.median([blob.side for blob in whole]))
    cells: dict[tuple[int, ...], int] = {}
    for blob in whole:
        for cell in np.unique(np.round((blob.cubes - blob.center) / side).astype(int), axis=0).tolist():
            cells[tuple(cell)] = cells.get(tuple(cell), 0) + 1
    kept = {cell for cell, count in cells.items() if count >= USUAL_FRACTION * len(whole)} or set(cells)
    steps = [(0, 0, 1), (0, 0, -1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0)]
    inner = {c for c in kept if all((c[0] + x, c[1] + y, c[2] + z) in kept for x, y, z in steps)}
    return np.array(sorted(kept - inner), float) * side, side


def _colors(points: np.ndarray, track: Track, footage: Sequence[Footage]) -> tuple[np.ndarray, np.ndarray]:
    total, count = np.zeros((len(points), 3)), np.zeros((len(points), 1))
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
    return np.where(count > 0, total / np.maximum(count, 1), usual), count > 0
