"""Where motion begins before cameras that stand still: at what they see to change, at each time
anew."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.core.conventions import SH_C0
from dyngs.deform.fixed_cameras.hulls import (
    FixedCameraClip,
    Track,
    extract_blobs,
    link_tracks,
    silhouettes_at,
)
from dyngs.deform.random_gaussians import box_of
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.ops.quaternions import rotate

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
class TimedGaussians:
    """Gaussians that are there at one time."""

    time: float
    gaussians: Gaussians
    velocity: Tensor  # (3,) world units per clip


def track_gaussians(
    track: Track, clips: Sequence[FixedCameraClip], thinned: float, num_terms: int
) -> list[TimedGaussians]:
    """Return Gaussians on the surface of what ``track`` follows, one for ``thinned`` of its cubes,
    for each time.

    Each has the mean of its colours in the images of its time in which it is on the side of the
    camera and the image changes there. What travels has the surface of the cubes, in its own frame,
    which lie in its hulls at many times; other things have that of the hull of the time. Times are
    left out at which the Gaussians do not pay.
    """
    usual = surface(track)
    pace = np.gradient(track.centers, np.array(track.times), axis=0)
    found: list[TimedGaussians] = []
    for time, blob, velocity in zip(track.times, track.blobs, pace, strict=True):
        here = Track((time,), (blob,))
        points, side = usual if track.is_travelling else surface(here)
        dense = _on_surface(points, side, here, clips, num_terms)
        if improves_images(dense, time, clips):
            gaussians = _thinned(dense, max(round(len(points) / thinned), 1))
            found.append(
                TimedGaussians(
                    time, gaussians, torch.from_numpy(velocity * track.is_travelling).float()
                )
            )
    return found


def _thinned(gaussians: Gaussians, count: int) -> Gaussians:
    """Return ``count`` of the Gaussians, evenly chosen, so much larger that they cover as much."""
    rows = torch.linspace(0, len(gaussians) - 1, count, device="cpu").round().long()
    kept = gaussians.select(rows)
    return kept.replace(log_scales=kept.log_scales + 0.5 * math.log(len(gaussians) / count))


def improves_images(gaussians: Gaussians, time: float, clips: Sequence[FixedCameraClip]) -> bool:
    """Return whether ``gaussians``, drawn over the cameras' medians, are nearer to the images of
    ``time`` than these.

    Over the pixels that they cover, in the images in which the thing is not hidden. A false hull,
    where silhouettes of different things cross, does not pay.
    """
    before = after = 0.0
    looked_at = shown = 0
    for one in (one for one in clips if time in one.times):
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
        truth, static = (torch.from_numpy(x).float() / 255 for x in (one.images[i], one.median))
        before += float((static - truth).square().sum(-1)[covered].sum())
        after += float(
            (drawn.rgb[0] + (1 - alpha) * static - truth).square().sum(-1)[covered].sum()
        )
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
    points: np.ndarray, side: float, here: Track, clips: Sequence[FixedCameraClip], num_terms: int
) -> Gaussians:
    base = torch.from_numpy((_colors(points, here, clips) - 0.5) / SH_C0).float()
    means = torch.from_numpy(points + here.centers[0]).float()
    return Gaussians.isotropic(means, math.log(SCALE * side), LOGIT, base, num_terms)


def _colors(points: np.ndarray, track: Track, clips: Sequence[FixedCameraClip]) -> np.ndarray:
    total = np.zeros((len(points), 3))
    count = np.zeros((len(points), 1))
    outward = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-9)
    for time, center in zip(track.times, track.centers, strict=True):
        for view in silhouettes_at(clips, time):
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


SHOWS = 0.1  # Sum of weights, in pixels, from which a Gaussian counts as visible in an image
FEWEST_CAMERAS = 2  # That must see a Gaussian: what one sees may be before it
CHANGE = 0.05  # Least change of a channel, of 1
LIFT = 0.5  # Distance of a copy before its original, in longest standard deviations


def detect_surface_changes(
    clips: Sequence[FixedCameraClip], static: Gaussians, options: RenderOptions, limit: int
) -> list[TimedGaussians]:
    """Return copies of ``still`` Gaussians at the times at which most cameras see another colour
    there, in this colour.

    The change of a Gaussian is the median over cameras of sum_p w_p (truth - median) / sum_p w_p
    with w = alpha T; that of what is only covered by something else differs from camera to camera.
    At most ``limit``, those that change most.
    """
    graphs = [_blended(static, one, options) for one in clips]
    towards = torch.cat([one.camera.centers for one in clips]).to(static.means).mean(0)
    found: list[tuple[float, Tensor, Tensor]] = []
    for time in sorted({time for one in clips for time in one.times}):
        seen: list[Tensor] = []
        for one, (flat, blended, weights) in zip(clips, graphs, strict=True):
            if time not in one.times:
                continue
            i = one.times.index(time)
            error = (
                torch.from_numpy(one.images[i]).float() - torch.from_numpy(one.median).float()
            ) / 255
            error = (error * torch.from_numpy(one.counted[i])[..., None]).to(blended)
            (sums,) = torch.autograd.grad(blended, flat, error, retain_graph=True)
            seen.append(torch.where(weights > SHOWS * SH_C0, sums[:, 0] / weights, torch.nan))
        change = torch.stack(seen)
        usual = change.nanmedian(0).values
        rows = torch.nonzero(
            (usual.abs().amax(1) > CHANGE) & ((~change[..., 0].isnan()).sum(0) >= FEWEST_CAMERAS)
        )[:, 0]
        found.append((time, rows, usual[rows]))
    sizes = torch.cat([usual.abs().amax(1) for _, _, usual in found]).sort(descending=True).values
    least = float(sizes[limit]) if len(sizes) > limit else 0.0
    timed_gaussians: list[TimedGaussians] = []
    for time, rows, usual in found:
        kept = usual.abs().amax(1) > least
        if bool(kept.any()):
            copies = _recoloured(static.select(rows[kept]), usual[kept], towards)
            timed_gaussians.append(TimedGaussians(time, copies, static.means.new_zeros(3)))
    return timed_gaussians


def _blended(
    static: Gaussians, one: FixedCameraClip, options: RenderOptions
) -> tuple[Tensor, Tensor, Tensor]:
    """Return a constant colour, its blending, and the (N, 1) sums of weights, of every Gaussian in
    one camera."""
    flat = torch.zeros(len(static), 1, 3, requires_grad=True, device=static.means.device)
    blended = render(
        static.replace(sh=flat), one.camera.to(device=static.means.device), options
    ).rgb[0]
    (weights,) = torch.autograd.grad(blended, flat, torch.ones_like(blended), retain_graph=True)
    return flat, blended, weights[:, 0, :1]


def _recoloured(gaussians: Gaussians, change: Tensor, towards: Tensor) -> Gaussians:
    """Return ``gaussians`` with other base colours, a little before themselves as seen from
    ``towards`` (3,)."""
    shortest = torch.nn.functional.one_hot(gaussians.log_scales.argmin(1), 3).to(gaussians.means)
    normals = rotate(gaussians.quats, shortest)
    signs = ((towards - gaussians.means) * normals).sum(1, keepdim=True).sign()
    lift = LIFT * gaussians.scales.amax(1, keepdim=True)
    sh = gaussians.sh.clone()
    sh[:, 0] += change / SH_C0
    logits = gaussians.logit_opacities.clamp_min(LOGIT)
    return gaussians.replace(
        means=gaussians.means + signs * lift * normals, sh=sh, logit_opacities=logits
    )


ROOM = 0.25  # Room around the things that stand still and the cameras, in sides of their box


@dataclass(frozen=True)
class InitialMotion:
    """What changes, as Gaussians at single times."""

    timed_gaussians: tuple[TimedGaussians, ...] = ()
    message: str | None = None


def find_initial_motion(
    clips: Sequence[FixedCameraClip],
    static: Gaussians,
    extent: float,
    limit: int,
    options: RenderOptions,
) -> InitialMotion:
    """Return what changes before the cameras of ``clips``, where ``still`` Gaussians are or the
    cameras look.

    At most about ``limit`` Gaussians on things, and as many on still surfaces that look different
    at times.
    """
    if len(clips) < 2 or limit < 1:
        return InitialMotion()
    tracks = find_tracks(clips, *_box(clips, static, extent))
    cubes = sum(len(surface(track)[0]) * len(track.times) for track in tracks)
    thinned = max(cubes / limit, 1.0)
    num_terms = static.sh.shape[1]
    things = [
        timed_gaussians
        for timed_gaussians in (track_gaussians(x, clips, thinned, num_terms) for x in tracks)
        if timed_gaussians
    ]
    shades = detect_surface_changes(clips, static, options, limit)
    timed_gaussians = tuple(moment for group in (*things, shades) for moment in group)
    if not timed_gaussians:
        return InitialMotion()
    total = len(_times(clips))
    count = sum(len(one.gaussians) for one in timed_gaussians)
    lengths = ", ".join(str(len(one)) for one in things)
    what = f"things that move found at {lengths} of {total} times" if things else "surfaces change"
    return InitialMotion(
        timed_gaussians, f"{what} before the fixed cameras: {count:,} Gaussians begin there"
    )


def find_tracks(clips: Sequence[FixedCameraClip], low: np.ndarray, high: np.ndarray) -> list[Track]:
    """Return the tracks of all that moves in the box from ``low`` to ``high`` (3,), longest
    first."""
    times = _times(clips)
    return link_tracks(
        times, [extract_blobs(silhouettes_at(clips, time), low, high) for time in times]
    )


def _box(
    clips: Sequence[FixedCameraClip], static: Gaussians, extent: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return two corners (3,) of a box with the still things and the cameras, and some room
    around."""
    center, half_size = (x.double().cpu().numpy() for x in box_of(static, extent))
    centers = np.concatenate([one.camera.centers.double().cpu().numpy() for one in clips])
    low = np.minimum(center - half_size, centers.min(0))
    high = np.maximum(center + half_size, centers.max(0))
    room = ROOM * (high - low).max()
    return low - room, high + room


def _times(clips: Sequence[FixedCameraClip]) -> list[float]:
    return sorted({time for one in clips for time in one.times})
