"""Paths of things that move before one moving camera, from where the static model fails.

A thing is a ball here: a disc in every image. Three discs in nearby images fix a straight path; the best are followed
outwards in time, each image adding the ray on which the thing must lie, to a smooth path through all.

Local letters: T images, n candidates, K peaks, S sizes of discs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dyngs.deform.bodies.shots import Shots

SIZES, SMALLEST, LARGEST = 9, 3.0, 0.2  # Radii of discs: number, least in pixels, greatest in image widths
PEAKS, LEAST_PEAK = 6, 0.08
HALF = 3  # Images on either side that a straight path is tried on
TRIPLES = 400  # Candidates per middle image
FOLLOWED = 8  # Candidates that are followed through all images
LEAST_SUPPORT = 0.28  # Contrast of a disc with its ring, mean over images, from which it is a thing
MOST_THINGS = 4
STIFFNESS = 3.0


@dataclass(frozen=True)
class Path:
    """A ball of ``radius`` at T times."""

    centers: np.ndarray  # (T, 3)
    radius: float
    support: float  # mean contrast


class Discs:
    """Mean of a map in a disc less that in the ring around it, for discs of all sizes at all pixels of T images."""

    def __init__(self, maps: np.ndarray) -> None:
        self.radii = np.geomspace(SMALLEST, max(LARGEST * maps.shape[2], 2 * SMALLEST), SIZES)
        edge = int(np.ceil(1.7 * self.radii[-1]))
        padded = np.pad(maps, ((0, 0), (edge, edge), (edge, edge)))
        shape = padded.shape[1:]
        y, x = (np.minimum(i, n - i) for i, n in zip(np.indices(shape), shape, strict=True))
        away = np.hypot(y, x)
        spectrum = np.fft.rfft2(padded)
        values = []
        for radius in self.radii:
            disc = np.clip(radius - away + 0.5, 0, 1)
            ring = np.clip(1.6 * radius - away + 0.5, 0, 1) - np.clip(1.15 * radius - away + 0.5, 0, 1)
            kernel = np.fft.rfft2(disc / disc.sum() - ring / ring.sum())
            values.append(np.fft.irfft2(spectrum * kernel, s=shape)[:, edge:-edge, edge:-edge])
        self.values = np.stack(values, axis=1).astype(np.float32)  # (T, S, H, W)

    def at(self, which: np.ndarray, pixels: np.ndarray, radii: np.ndarray) -> np.ndarray:
        """Return the (n,) values at ``pixels`` (n, 2) for discs of ``radii`` (n,) pixels, -0.2 out of the images."""
        _, sizes, height, width = self.values.shape
        ratio = self.radii[1] / self.radii[0]
        level = np.log(np.maximum(radii, 1e-3) / self.radii[0]) / np.log(ratio)
        out = (pixels < 0).any(1) | (pixels > [width, height]).any(1) | (level < -1.2) | (level > sizes + 0.2)
        level = np.clip(level, 0, sizes - 1.001)
        place = np.clip(pixels - 0.5, 0, np.array([width, height]) - 1.001)
        (x, y), k = place.astype(int).T, level.astype(int)
        fx, fy, fk = place[:, 0] - x, place[:, 1] - y, level - k
        total = np.zeros(len(pixels))
        for dk, wk in ((0, 1 - fk), (1, fk)):
            for dy, wy in ((0, 1 - fy), (1, fy)):
                for dx, wx in ((0, 1 - fx), (1, fx)):
                    total += wk * wy * wx * self.values[which, k + dk, y + dy, x + dx]
        return np.where(out, -0.2, total)

    def peaks(self, index: int) -> np.ndarray:
        """Return the (K, 3) x, y and radius of the most marked discs of one image, in pixels."""
        from scipy.ndimage import maximum_filter

        values = self.values[index]
        k, y, x = np.nonzero((values == maximum_filter(values, size=(3, 5, 5))) & (values > LEAST_PEAK))
        best = np.argsort(-values[k, y, x] * np.sqrt(self.radii[k]), kind="stable")[:PEAKS]
        return np.stack([x[best] + 0.5, y[best] + 0.5, self.radii[k[best]]], axis=1)


def found_paths(shots: Shots) -> list[Path]:
    """Return the paths of what moves, the most marked first; each is taken out before the next is sought."""
    maps, paths = shots.differences(), []
    random = np.random.default_rng(0)
    while len(shots) > 2 * HALF and len(paths) < MOST_THINGS:
        discs = Discs(maps)
        starts = sorted(_straight_paths(shots, discs, random), key=lambda start: -start[0])[:FOLLOWED]
        followed = [_followed(shots, discs, *start[1:]) for start in starts]
        if not followed or max(path.support for path in followed) < LEAST_SUPPORT:
            break
        paths.append(max(followed, key=lambda path: path.support))
        clear_(maps, shots, paths[-1])
    return paths


def clear_(maps: np.ndarray, shots: Shots, path: Path) -> None:
    """Set ``maps`` (T, H, W) to 0 where the thing on ``path`` is seen, and a little around it."""
    for i, center in enumerate(path.centers):
        rows, columns, _ = shots.on_ball(i, center, 1.2 * path.radius, 1.0)
        maps[i, rows, columns] = 0


def _contrast(shots: Shots, discs: Discs, centers: np.ndarray, radius: float) -> np.ndarray:
    which = np.arange(len(shots))
    pixels, depths = shots.projected(which, centers)
    return discs.at(which, pixels, radius * shots.focal / depths)


def _straight_paths(
    shots: Shots, discs: Discs, random: np.random.Generator
) -> list[tuple[float, int, np.ndarray, np.ndarray, float]]:
    """Return contrast, middle image, centre and step (3,) per image there, and radius of straight paths."""
    peaks, found = [discs.peaks(i) for i in range(len(shots))], []
    for middle in range(HALF, len(shots) - HALF, 2):
        near = [t for t in range(middle - HALF, middle + HALF + 1) if len(peaks[t])]
        if len(near) < 3:
            continue
        which = random.permuted(np.tile(near, (TRIPLES, 1)), axis=1)[:, :3]
        ranks = random.integers(0, np.array([len(one) for one in peaks])[which])
        picked = np.array([[peaks[t][k] for t, k in zip(*row, strict=True)] for row in zip(which, ranks, strict=True)])
        centers, steps, radii = _through(shots, which, middle, picked)
        which = np.arange(middle - HALF, middle + HALF + 1)
        values = []
        for t in which:
            pixels, depths = shots.projected(np.full(len(centers), t), centers + (t - middle) * steps)
            values.append(discs.at(np.full(len(centers), t), pixels, radii * shots.focal[t] / depths))
        score = np.sort(np.array(values), axis=0)[1:].mean(0)
        for i in np.argsort(-score, kind="stable")[:6]:
            found.append((float(score[i]), middle, centers[i], steps[i], float(radii[i])))
    return found


def _through(
    shots: Shots, which: np.ndarray, middle: int, picked: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centres (n, 3), steps (n, 3) and radii (n,) of paths through three discs each, where these agree."""
    count, flat = len(which), which.ravel()
    ways = shots.rays(flat, picked[..., :2].reshape(-1, 2))
    across = np.eye(3) - ways[:, :, None] * ways[:, None]
    later = (which - middle).astype(float)
    across = across.reshape(count, 3, 3, 3)
    seen = np.einsum("ntij,ntj->nti", across, shots.centers[flat].reshape(count, 3, 3))
    blocks = [[np.einsum("nt,ntij->nij", later ** (a + b), across) for b in range(2)] for a in range(2)]
    left = np.concatenate([np.concatenate(row, axis=2) for row in blocks], axis=1)
    left[:, range(6), range(6)] += 1e-6
    right = np.concatenate([np.einsum("nt,nti->ni", later**a, seen) for a in range(2)], axis=1)
    solved = np.linalg.solve(left, right[..., None])[..., 0]
    centers, steps = solved[:, :3], solved[:, 3:]
    places = (centers[:, None] + later[..., None] * steps[:, None]).reshape(-1, 3)
    pixels, depths = shots.projected(flat, places)
    misses = np.linalg.norm(pixels.reshape(count, 3, 2) - picked[..., :2], axis=-1).max(1)
    sizes = np.log(picked[..., 2] * (depths / shots.focal[flat]).reshape(count, 3))
    radii = np.exp(sizes.mean(1))
    agree = (misses < 0.35 * picked[..., 2].min(1)) & (np.ptp(sizes, axis=1) < 1)
    agree &= (depths.reshape(count, 3) > 1e-3).all(1) & (np.linalg.norm(steps, axis=1) < 1.5 * radii)
    return centers[agree], steps[agree], radii[agree]


def _followed(shots: Shots, discs: Discs, middle: int, center: np.ndarray, step: np.ndarray, radius: float) -> Path:
    """Return the smooth path through all images that begins straight around ``middle``."""
    count, which = len(shots), np.arange(len(shots))
    ways, weights = np.zeros((count, 3)), np.zeros(count)

    def look(t: int, guess: np.ndarray, reach: float) -> None:
        (pixel,), (depth,) = shots.projected(which[t : t + 1], guess[None])
        size = radius * shots.focal[t] / depth
        far = max(1.0, reach * size)
        grid = np.arange(-far, far + 0.1, max(0.5, far / 8))
        shift = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
        values = discs.at(np.full(len(shift), t), pixel + shift, np.full(len(shift), size))
        best = int(np.argmax(values - 0.15 * (shift**2).sum(1) / far**2))
        ways[t] = shots.rays(which[t : t + 1], (pixel + shift[best])[None])[0]
        weights[t] = max(float(values[best]), 0.0) ** 2

    low, high = middle - HALF, middle + HALF
    for t in range(low, high + 1):
        look(t, center + (t - middle) * step, 0.5)
    centers = _smooth(shots, ways, weights)
    while low > 0 or high < count - 1:
        for t in {max(low - 1, 0), min(high + 1, count - 1)} - set(range(low, high + 1)):
            look(t, centers[t], 0.7)
        low, high = max(low - 1, 0), min(high + 1, count - 1)
        centers = _smooth(shots, ways, weights)
    for turn in range(8):
        for t in range(count):
            look(t, centers[t], 0.5)
        centers = _smooth(shots, ways, weights)
        if turn % 2:
            sizes = radius * np.geomspace(0.8, 1.25, 9)
            radius = float(sizes[np.argmax([_contrast(shots, discs, centers, size).mean() for size in sizes])])
    return Path(centers, radius, float(_contrast(shots, discs, centers, radius).mean()))


def _smooth(shots: Shots, ways: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the (T, 3) places nearest to the rays along ``ways``, with small second differences.

    Least squares; images of weight 0 have no ray, and the path goes straight on there.
    """
    from scipy.linalg import solveh_banded

    count = len(shots)
    stiffness = STIFFNESS * float(np.median(weights[weights > 0])) if (weights > 0).any() else 1.0
    across = weights[:, None, None] * (np.eye(3) - ways[:, :, None] * ways[:, None])
    right = np.einsum("tij,tj->ti", across, shots.centers).ravel()
    full = np.zeros((7, 3 * count))  # upper bands: entry (i, j) lies in row 6 + i - j, column j
    for i in range(3):
        for j in range(i, 3):
            full[6 + i - j, j::3] += across[:, i, j]
    second = np.diff(np.eye(count), n=2, axis=0)
    bend = stiffness * np.einsum("ki,kj->ij", second, second)
    for gap in range(3):
        full[6 - 3 * gap, 3 * gap :] += np.repeat(np.diagonal(bend, gap), 3)
    full[6] += 1e-9
    return solveh_banded(full, right).reshape(count, 3)
