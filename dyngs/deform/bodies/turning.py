"""How things turn along their paths, from the colours of their surfaces: a search that needs no model of them.

For a hypothesis of the rotations, every pixel falls on one direction in the body's own frame. Colours that fall on the
same cell in several images must agree, once the light has been divided out. First, few numbers describe a few images:
a constant rate, alone or added to rolling on the plane of the path or to turning with its direction. From where colours
agree best, the rotation is followed image by image in both directions; at last every image is searched around its
place against all others.

Local letters: T images, H hypotheses, n pixels, C cells of the sphere, B basis motions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from dyngs.deform.bodies.paths import Path
from dyngs.deform.bodies.shots import Shots
from dyngs.ops.harmonics import light_harmonics

COARSE, FINE = 6, 8  # Cells along an edge of the cube that the sphere is divided by
MOST_PIXELS, FEWER_PIXELS = 250, 80  # Of a body in an image that are looked at, and that the first search looks at
FEWEST_PIXELS = 50  # Of a body in an image, for that image to say how it turns
LEAST_PIXELS = 2  # In a cell, for its mean colour to count
CUT, UNKNOWN = 0.37, 0.13  # Squared colour differences: the greatest that counts, and that of cells never seen
WINDOW, FREE_DEG, GIVEN_DEG, STEP_DEG = 14, 200.0, 60.0, 30.0
"""Images that few numbers describe, and turns in that time that are tried: without another motion, and added to one."""
LEAST_SEEN = 0.6  # Of the images of a window, for it to begin with
REFINED, ROUNDS, SAMPLES = 4, 4, 32
FOLLOWED = 3  # Windows from which the rotation is followed; the one whose colours agree best in all is taken
PACE = 3  # Images over which the rate is measured that the next is expected to turn at
FOLLOWED_DEG = (20.0, 5.0, 1e-4)
ROUNDS_DEG = ((10.0, 5.0, 1e-4), (5.0, 2.5, 2e-4), (3.0, 1.5, 2e-4))
"""Reach and step of the search around each image's rotation, and the weight of squared degrees from what is expected:
where it is followed, and in rounds at last."""

Frames = Sequence[tuple[np.ndarray, np.ndarray]]
"""For each of T images (n, 3) unit normals in the world and (n, 3) colours."""


@dataclass(frozen=True)
class Turning:
    """Rotations of a body along its path.

    Attributes:
        rotations: (T, 3, 3) body to world; the identity in the middle.
        disagreement: mean squared difference of colours on the same cell, of another image's.
        standing: the same if the body did not turn.
        by_chance: the same of any two of its colours.
        colors: (C, 3) mean colour of each of the ``FINE`` cells, light divided out.
        counts: (C,) pixels that fell on it.
    """

    rotations: np.ndarray
    disagreement: float
    standing: float
    by_chance: float
    colors: np.ndarray
    counts: np.ndarray


def found_turning(shots: Shots, path: Path) -> Turning:
    """Return how the body on ``path`` turns."""
    frames = without_light([_frame(shots, path, t) for t in range(len(shots))])
    starts = _windows(frames, _basis(shots.times, path))
    still = np.broadcast_to(np.eye(3), (len(frames), 3, 3))
    tried = np.stack([_polished(frames, _followed(frames, *start)) for start in starts] or [still])
    rotations = tried[disagreements(frames, tried).argmin()]
    rotations = np.einsum("tij,kj->tik", rotations, rotations[len(frames) // 2])
    sums, counts = _total([_sums(frame, rotation) for frame, rotation in zip(frames, rotations, strict=True)])
    moved, stood = disagreements(frames, np.stack([rotations, still]))
    every = np.concatenate([colors for _, colors in frames])
    by_chance = 2 * float(every.var(axis=0).sum()) if len(every) else 0.0
    return Turning(rotations, float(moved), float(stood), by_chance, sums / np.maximum(counts, 1)[:, None], counts)


def _frame(shots: Shots, path: Path, index: int) -> tuple[np.ndarray, np.ndarray]:
    rows, columns, normals = shots.on_ball(index, path.centers[index], path.radius)
    step = max(len(rows) // MOST_PIXELS, 1)
    return normals[::step], shots.images[index, rows[::step], columns[::step]]


def without_light(frames: Frames) -> Frames:
    """Return the frames divided by the light: second-order harmonics of the normal in the world.

    Ramamoorthi and Hanrahan (2001): diffuse light has no finer detail. What turns averages out of the fit.
    """
    normals, colors = (np.concatenate(x) for x in zip(*frames, strict=True))
    if not len(normals):
        return frames
    light = np.linalg.lstsq(_harmonics(normals), colors, rcond=None)[0]
    usual = colors.mean(0)
    return [(n, c / np.clip(_harmonics(n) @ light, 0.15, 2.0) * usual) for n, c in frames]


def cells(normals: np.ndarray, size: int) -> np.ndarray:
    """Return (...) indices below 6 ``size``^2 of the cells of a cube that vectors (..., 3) point at."""
    axis = np.abs(normals).argmax(-1)
    along, first, second = (np.take_along_axis(normals, ((axis + k) % 3)[..., None], -1)[..., 0] for k in range(3))
    face = 2 * axis + (along < 0)
    column, row = (
        np.clip(((np.arctan(x / np.abs(along)) * 4 / np.pi + 1) / 2 * size).astype(int), 0, size - 1)
        for x in (first, second)
    )
    return (face * size + column) * size + row


def disagreements(frames: Frames, rotations: np.ndarray) -> np.ndarray:
    """Return for ``rotations`` (H, T, 3, 3) the (H,) mean squared differences of colours that fall on the same cell.

    Over all pairs of images that show a cell; hypotheses with few such pairs score 9.
    """
    count, cells_all = len(rotations), 6 * COARSE**2
    first = (np.arange(count) * cells_all)[:, None]
    sums = np.zeros((count, cells_all, 3))
    squares, shown = np.zeros((count, cells_all)), np.zeros((count, cells_all))
    for t, (normals, colors) in enumerate(frames):
        if not len(normals):
            continue
        turned = np.einsum("pi,hij->hpj", normals, rotations[:, t])
        place = (cells(turned, COARSE) + first).ravel()
        pixels = np.bincount(place, minlength=count * cells_all).reshape(count, cells_all)
        own = [np.bincount(place, np.tile(c, count), count * cells_all).reshape(count, cells_all) for c in colors.T]
        counts = pixels >= LEAST_PIXELS
        mean = np.stack(own, axis=-1) / np.maximum(pixels, 1)[..., None] * counts[..., None]
        sums, squares, shown = sums + mean, squares + (mean**2).sum(-1), shown + counts
    pairs = (shown * (shown - 1) / 2).sum(1)
    apart = np.where(shown > 1, squares * shown - (sums**2).sum(-1), 0).sum(1) / np.maximum(pairs, 1)
    return np.where(pairs > 0.4 * np.median(pairs), apart, 9.0)


def rotations_by(vectors: np.ndarray) -> np.ndarray:
    """Return (..., 3, 3) rotations about the vectors (..., 3) by their lengths, radians."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def angles_deg(rotations: np.ndarray) -> np.ndarray:
    """Return (...) angles of rotations (..., 3, 3)."""
    return np.degrees(np.arccos(np.clip((np.trace(rotations, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))


def integrated(numbers: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Return (H, T, 3, 3) rotations, the identity in the middle, for ``numbers`` (H, B) of ``basis`` (B, T - 1, 3)."""
    steps = rotations_by(np.einsum("hb,btd->htd", numbers, basis))
    found = np.empty((len(steps), steps.shape[1] + 1, 3, 3))
    found[:, 0] = np.eye(3)
    for t in range(steps.shape[1]):
        found[:, t + 1] = np.einsum("hij,hjk->hik", steps[:, t], found[:, t])
    return np.einsum("htij,hkj->htik", found, found[:, found.shape[1] // 2])


def _basis(times: np.ndarray, path: Path) -> np.ndarray:
    """Return (5, T - 1, 3) turns from image to image, radians in the world.

    Rolling on the plane of the path, turning with the path's direction, and one radian per clip about each axis.
    """
    centers, gaps = path.centers, np.diff(times)[:, None]
    normal = np.linalg.svd(centers - centers.mean(0))[2][2]
    normal = normal * (1 if normal[2] >= 0 else -1)
    rolling = np.cross(normal, np.diff(centers, axis=0)) / path.radius
    speed = np.gradient(centers, times, axis=0)
    bend = np.cross(speed, np.gradient(speed, times, axis=0))
    square = (speed**2).sum(1, keepdims=True)
    heading = bend / np.maximum(square, 1e-3 * square.max() + 1e-12)
    heading = np.clip(0.5 * (heading[1:] + heading[:-1]) * gaps, -1, 1)
    return np.concatenate([[rolling, heading], np.eye(3)[:, None] * gaps])


def _windows(frames: Frames, basis: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Return the first image of the windows that colours agree best in, and (W, 3, 3) rotations there."""
    steps = [max(len(normals) // FEWER_PIXELS, 1) for normals, _ in frames]
    thin = [(n[t % k :: k], c[t % k :: k]) for t, ((n, c), k) in enumerate(zip(frames, steps, strict=True))]
    size, found = min(WINDOW, len(frames)), []
    last = len(frames) - size
    for first in sorted({*range(0, last + 1, max(size - 1, 1)), last}):
        part = thin[first : first + size]
        if np.mean([len(normals) >= FEWEST_PIXELS for normals, _ in part]) < LEAST_SEEN:
            continue
        turns = basis[:, first : first + size - 1].copy()
        turns[2:] /= turns[2:].sum(1).max()
        score, numbers = _best_numbers(part, turns)
        by_chance = float(np.concatenate([colors for _, colors in part]).var(axis=0).sum())
        found.append((score / max(by_chance, 1e-6), first, integrated(numbers[None], turns)[0]))
    return [start[1:] for start in sorted(found, key=lambda start: start[:2])[:FOLLOWED]]


def _best_numbers(frames: Frames, basis: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the disagreement and the (5,) numbers with which it is least: a grid, then random steps from the best."""

    def score(numbers: np.ndarray) -> np.ndarray:
        parts = np.split(numbers, range(64, len(numbers), 64))
        return np.concatenate([disagreements(frames, integrated(part, basis)) for part in parts])

    tried: list[tuple[float, np.ndarray]] = []
    for given in ((0, 0), (1, 0), (-1, 0), (0, 1)):
        free = np.radians(_ball_of(GIVEN_DEG if any(given) else FREE_DEG, STEP_DEG))
        numbers = np.concatenate([np.tile(given, (len(free), 1)), free], axis=1).astype(float)
        scores = score(numbers)
        tried += [(float(scores[i]), numbers[i]) for i in np.argsort(scores, kind="stable")[:3]]
    random, found = np.random.default_rng(0), []
    for best, numbers in sorted(tried, key=lambda x: x[0])[:REFINED]:
        spread = np.array([0.1, 0.1, 0.3, 0.3, 0.3]) * np.where(np.arange(5) < 2, numbers != 0, True)
        for _ in range(ROUNDS):
            around = numbers + random.normal(size=(SAMPLES, 5)) * spread
            scores = score(around)
            if scores.min() < best:
                best, numbers = float(scores.min()), around[scores.argmin()]
            else:
                spread = 0.6 * spread
            spread = 0.85 * spread
        found.append((best, numbers))
    return min(found, key=lambda x: x[0])


def _followed(frames: Frames, first: int, known: np.ndarray) -> np.ndarray:
    """Return (T, 3, 3) rotations: those ``known`` (W, 3, 3) from image ``first`` on, polished, and followed from there.

    Each image is searched around where the last ones' rate takes it, against the colours of all before it.
    """
    from scipy.spatial.transform import Rotation

    reach, step, pull = FOLLOWED_DEG
    around, high = rotations_by(np.radians(_ball_of(reach, step))), first + len(known) - 1
    rotations = np.broadcast_to(np.eye(3), (len(frames), 3, 3)).copy()
    rotations[first : high + 1] = _polished(frames[first : high + 1], known)
    sums, counts = _total([_sums(frames[t], rotations[t]) for t in range(first, high + 1)])
    pace = min(PACE, len(known) - 1)
    outside = [t for t in range(len(frames)) if not first <= t <= high]
    for t in sorted(outside, key=lambda t: (abs(2 * t - first - high), -t)):
        way = 1 if t > high else -1
        last = rotations[t - way]
        rate = Rotation.from_matrix(last @ rotations[t - (1 + pace) * way].T).as_rotvec() / pace
        expected = rotations_by(rate) @ last
        rotations[t] = _best_of(frames[t], around, expected, (sums, counts), pull * angles_deg(around) ** 2)
        own = _sums(frames[t], rotations[t])
        sums, counts = sums + own[0], counts + own[1]
    return rotations


def _best_of(
    frame: tuple[np.ndarray, np.ndarray],
    around: np.ndarray,
    center: np.ndarray,
    seen: tuple[np.ndarray, np.ndarray],
    pull: np.ndarray,
) -> np.ndarray:
    """Return the rotation, of ``around`` (H, 3, 3) after ``center``, with which colours agree best with those ``seen``.

    Args:
        seen: (C, 3) sums of colours and (C,) numbers of pixels.
        pull: (H,) to be added to the disagreement.
    """
    normals, colors = frame
    if len(normals) < FEWEST_PIXELS:
        return center
    tried, (sums, counts) = np.einsum("hij,jk->hik", around, center), seen
    place = cells(np.einsum("pi,hij->hpj", normals, tried), FINE)
    apart = np.minimum((((sums / np.maximum(counts, 1)[:, None])[place] - colors) ** 2).sum(-1), CUT)
    return tried[np.argmin(np.where(counts[place] >= LEAST_PIXELS, apart, UNKNOWN).mean(1) + pull)]


def _polished(frames: Frames, rotations: np.ndarray) -> np.ndarray:
    """Return ``rotations`` (T, 3, 3), each moved to where its image agrees best with the map of all the others."""
    from scipy.spatial.transform import Rotation

    found = rotations.copy()
    for reach, step, pull in ROUNDS_DEG:
        around = rotations_by(np.radians(_ball_of(reach, step)))
        own = [_sums(frame, rotation) for frame, rotation in zip(frames, found, strict=True)]
        sums, counts = _total(own)
        for t, frame in enumerate(frames):
            expected = found[t]
            if 0 < t < len(frames) - 1:
                half = Rotation.from_matrix(found[t + 1] @ found[t - 1].T).as_rotvec() / 2
                expected = rotations_by(half) @ found[t - 1]
            sums, counts = sums - own[t][0], counts - own[t][1]
            if len(frame[0]) < FEWEST_PIXELS:
                found[t] = expected
            else:
                bend = angles_deg(np.einsum("hij,jk,lk->hil", around, found[t], expected))
                found[t] = _best_of(frame, around, found[t], (sums, counts), pull * bend**2)
            own[t] = _sums(frame, found[t])
            sums, counts = sums + own[t][0], counts + own[t][1]
    return found


def _sums(frame: tuple[np.ndarray, np.ndarray], rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the (C, 3) sums of colours that fall on the cells of the body's sphere, and the (C,) numbers of pixels."""
    normals, colors = frame
    place, count = cells(np.einsum("pi,ij->pj", normals, rotation), FINE), 6 * FINE**2
    sums = np.stack([np.bincount(place, c, count) for c in colors.T], axis=1)
    return sums, np.bincount(place, minlength=count)


def _total(parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    return np.sum([sums for sums, _ in parts], axis=0), np.sum([counts for _, counts in parts], axis=0)


def _ball_of(reach: float, step: float) -> np.ndarray:
    """Return the (H, 3) points of a grid in a ball."""
    side = np.arange(-reach, reach + 1e-6, step)
    grid = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(-1, 3)
    return grid[np.linalg.norm(grid, axis=1) <= reach + 1e-6]


def _harmonics(normals: np.ndarray) -> np.ndarray:
    """Return (n, 9) polynomials of unit vectors that span the harmonics up to order 2."""
    return torch.nn.functional.pad(light_harmonics(torch.from_numpy(normals)), (1, 0), value=1.0).numpy()
