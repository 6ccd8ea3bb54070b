"""Initial Gaussians of motion in front of fixed cameras, from visual hulls at each time."""

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

HULL_FRACTION = 0.4
"""Fraction of the times at which a cube must lie in the hull of its object to belong to it."""
COMPLETE_FRACTION = 0.75  # fraction of the median radius from which a hull is complete
SCALE = 0.6  # standard deviation of a Gaussian, in distances between them
LOGIT = 1.4  # opacity 0.8
MAX_ERROR_RATIO = (
    0.9  # largest remaining squared error, relative to the median images, in covered pixels
)
MIN_CHANGED_FRACTION = 0.4
"""Fraction of the covered pixels that must change in an image; else the object is occluded there.

Also the least fraction of images that are not occluded.
"""
COVERED = 0.1  # opacity from which a Gaussian covers a pixel


@dataclass(frozen=True)
class TimedGaussians:
    """Gaussians that exist at one time."""

    time: float
    gaussians: Gaussians
    velocity: Tensor  # (3,) world units per clip


def track_gaussians(
    track: Track, clips: Sequence[FixedCameraClip], thinned: float, num_terms: int
) -> list[TimedGaussians]:
    """Create Gaussians on the surface of a tracked object for each time; one per ``thinned``
    cubes.

    Colours are means over the images of the time in which the point faces the camera and the image
    changes. Travelling objects use cubes in the object frame that lie in its hulls at many times;
    other objects use the hull of each time. Times at which the Gaussians do not improve the images
    are left out.
    """
    usual = hull_surface(track)
    pace = np.gradient(track.centers, np.array(track.times), axis=0)
    timed: list[TimedGaussians] = []
    for time, blob, velocity in zip(track.times, track.blobs, pace, strict=True):
        here = Track((time,), (blob,))
        points, side = usual if track.is_travelling else hull_surface(here)
        dense = _place_on_surface(points, side, here, clips, num_terms)
        if improves_images(dense, time, clips):
            gaussians = _thinned(dense, max(round(len(points) / thinned), 1))
            timed.append(
                TimedGaussians(
                    time, gaussians, torch.from_numpy(velocity * track.is_travelling).float()
                )
            )
    return timed


def _thinned(gaussians: Gaussians, count: int) -> Gaussians:
    """Return ``count`` evenly chosen Gaussians, enlarged to cover the same area."""
    rows = torch.linspace(0, len(gaussians) - 1, count, device="cpu").round().long()
    kept = gaussians.select(rows)
    return kept.replace(log_scales=kept.log_scales + 0.5 * math.log(len(gaussians) / count))


def improves_images(gaussians: Gaussians, time: float, clips: Sequence[FixedCameraClip]) -> bool:
    """Return whether ``gaussians`` over the median images reduce the error at ``time``.

    Evaluated on the pixels that they cover, in images without occlusion. False hulls, at crossings
    of silhouettes of different objects, do not reduce the error.
    """
    before = after = 0.0
    compared = shown = 0
    for one in (one for one in clips if time in one.times):
        i = one.times.index(time)
        with torch.no_grad():
            drawn = render(gaussians, one.camera)
        alpha = drawn.alpha[0].reshape(*one.changed.shape[1:], 1)
        covered = (alpha[..., 0] > COVERED) & torch.from_numpy(one.counted[i])
        if not bool(covered.any()):
            continue
        compared += 1
        if float(torch.from_numpy(one.changed[i])[covered].float().mean()) < MIN_CHANGED_FRACTION:
            continue
        shown += 1
        truth, static = (torch.from_numpy(x).float() / 255 for x in (one.images[i], one.median))
        before += float((static - truth).square().sum(-1)[covered].sum())
        after += float(
            (drawn.rgb[0] + (1 - alpha) * static - truth).square().sum(-1)[covered].sum()
        )
    return shown >= MIN_CHANGED_FRACTION * compared and after < MAX_ERROR_RATIO * before


def hull_surface(track: Track) -> tuple[np.ndarray, float]:
    """Return surface points (S, 3) of a tracked object, relative to its centre, and the spacing."""
    whole = [blob for blob in track.blobs if blob.radius >= COMPLETE_FRACTION * track.radius]
    side = float(np.median([blob.side for blob in whole]))
    cells: dict[tuple[int, ...], int] = {}
    for blob in whole:
        for cell in np.unique(
            np.round((blob.cubes - blob.center) / side).astype(int), axis=0
        ).tolist():
            cells[tuple(cell)] = cells.get(tuple(cell), 0) + 1
    kept = {cell for cell, count in cells.items() if count >= HULL_FRACTION * len(whole)} or set(
        cells
    )
    steps = [(0, 0, 1), (0, 0, -1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0)]
    inner = {c for c in kept if all((c[0] + x, c[1] + y, c[2] + z) in kept for x, y, z in steps)}
    return np.array(sorted(kept - inner), float) * side, side


def _place_on_surface(
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
            _, shown = view.sample(center + points)
            rows = np.flatnonzero(faces & shown)
            if len(rows):
                x, y = np.floor(view.pixels((center + points)[rows])[0]).astype(int).T
                total[rows] += view.image[y, x] / 255
                count[rows] += 1
    usual = total.sum(0) / max(count.sum(), 1)
    return np.where(count > 0, total / np.maximum(count, 1), usual)


MIN_WEIGHT = 0.1  # sum of weights, in pixels, from which a Gaussian is visible in an image
MIN_CAMERAS = 2  # cameras that must see a Gaussian; a single camera may see an occluder
CHANGE = 0.05  # smallest change of a channel in [0, 1]
LIFT = 0.5  # distance of a copy in front of its original, in longest standard deviations


def detect_surface_changes(
    clips: Sequence[FixedCameraClip], static: Gaussians, options: RenderOptions, limit: int
) -> list[TimedGaussians]:
    """Create recoloured copies of ``static`` Gaussians at times at which most cameras see a
    change.

    The change of a Gaussian is the median over cameras of sum_p w_p (truth - median) / sum_p w_p
    with w = alpha T. Changes by occluders differ between cameras. At most ``limit`` copies, those
    that change most.
    """
    graphs = [_blend_constant(static, one, options) for one in clips]
    towards = torch.cat([one.camera.centers for one in clips]).to(static.means).mean(0)
    changes: list[tuple[float, Tensor, Tensor]] = []
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
            seen.append(torch.where(weights > MIN_WEIGHT * SH_C0, sums[:, 0] / weights, torch.nan))
        change = torch.stack(seen)
        usual = change.nanmedian(0).values
        rows = torch.nonzero(
            (usual.abs().amax(1) > CHANGE) & ((~change[..., 0].isnan()).sum(0) >= MIN_CAMERAS)
        )[:, 0]
        changes.append((time, rows, usual[rows]))
    sizes = torch.cat([usual.abs().amax(1) for _, _, usual in changes]).sort(descending=True).values
    least = float(sizes[limit]) if len(sizes) > limit else 0.0
    timed_gaussians: list[TimedGaussians] = []
    for time, rows, usual in changes:
        kept = usual.abs().amax(1) > least
        if bool(kept.any()):
            copies = _recolour(static.select(rows[kept]), usual[kept], towards)
            timed_gaussians.append(TimedGaussians(time, copies, static.means.new_zeros(3)))
    return timed_gaussians


def _blend_constant(
    static: Gaussians, one: FixedCameraClip, options: RenderOptions
) -> tuple[Tensor, Tensor, Tensor]:
    """Return a constant colour, its blended image, and weight sums (N, 1) of the Gaussians in one
    camera."""
    flat = torch.zeros(len(static), 1, 3, requires_grad=True, device=static.means.device)
    blended = render(
        static.replace(sh=flat), one.camera.to(device=static.means.device), options
    ).rgb[0]
    (weights,) = torch.autograd.grad(blended, flat, torch.ones_like(blended), retain_graph=True)
    return flat, blended, weights[:, 0, :1]


def _recolour(gaussians: Gaussians, change: Tensor, towards: Tensor) -> Gaussians:
    """Add ``change`` to the base colours, and move the Gaussians slightly towards ``towards``
    (3,)."""
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


MARGIN = 0.25  # margin around static Gaussians and cameras, in sides of their box


@dataclass(frozen=True)
class InitialMotion:
    """Motion found in front of fixed cameras, as Gaussians at single times."""

    timed_gaussians: tuple[TimedGaussians, ...] = ()
    message: str | None = None


def find_initial_motion(
    clips: Sequence[FixedCameraClip],
    static: Gaussians,
    extent: float,
    limit: int,
    options: RenderOptions,
) -> InitialMotion:
    """Find motion in front of the cameras of ``clips``: moving objects and changing surfaces.

    At most about ``limit`` Gaussians on objects, and as many on static surfaces whose colour
    changes.
    """
    if len(clips) < 2 or limit < 1:
        return InitialMotion()
    tracks = find_tracks(clips, *_box(clips, static, extent))
    cubes = sum(len(hull_surface(track)[0]) * len(track.times) for track in tracks)
    thinned = max(cubes / limit, 1.0)
    num_terms = static.sh.shape[1]
    objects = [
        timed_gaussians
        for timed_gaussians in (track_gaussians(x, clips, thinned, num_terms) for x in tracks)
        if timed_gaussians
    ]
    surfaces = detect_surface_changes(clips, static, options, limit)
    timed_gaussians = tuple(moment for group in (*objects, surfaces) for moment in group)
    if not timed_gaussians:
        return InitialMotion()
    total = len(_times(clips))
    count = sum(len(one.gaussians) for one in timed_gaussians)
    lengths = ", ".join(str(len(one)) for one in objects)
    what = (
        f"moving objects at {lengths} of {total} times"
        if objects
        else "surfaces that change colour"
    )
    return InitialMotion(timed_gaussians, f"found {what}; added {count:,} Gaussians there")


def find_tracks(clips: Sequence[FixedCameraClip], low: np.ndarray, high: np.ndarray) -> list[Track]:
    """Track all moving objects in the box from ``low`` to ``high`` (3,), longest tracks first."""
    times = _times(clips)
    return link_tracks(
        times, [extract_blobs(silhouettes_at(clips, time), low, high) for time in times]
    )


def _box(
    clips: Sequence[FixedCameraClip], static: Gaussians, extent: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (3,) of a box around static Gaussians and cameras, with a margin."""
    center, half_size = (x.double().cpu().numpy() for x in box_of(static, extent))
    centers = np.concatenate([one.camera.centers.double().cpu().numpy() for one in clips])
    low = np.minimum(center - half_size, centers.min(0))
    high = np.maximum(center + half_size, centers.max(0))
    margin = MARGIN * (high - low).max()
    return low - margin, high + margin


def _times(clips: Sequence[FixedCameraClip]) -> list[float]:
    return sorted({time for one in clips for time in one.times})
