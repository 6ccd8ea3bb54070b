"""How things turn along their paths, from the colours of their surfaces: a search that needs no
model of them.

For a hypothesis of the rotations, every pixel falls on one direction in the body's own frame.
Colours that fall on the same cell in several images must agree, once the light has been divided
out. First, few numbers describe a few images: a constant rate, alone or added to rolling on the
plane of the path or to turning with its direction. From where colours agree best, the rotation is
followed image by image in both directions; at last every image is searched around its place against
all others.

Local letters: T images, H hypotheses, n pixels, C cells of the sphere, B basis motions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import torch

from dyngs.core.conventions import SH_C0
from dyngs.deform.bodies.field import BodyField, BodyRestPose
from dyngs.deform.bodies.paths import FrameStack, Path, clear_path_, find_paths
from dyngs.deform.control_nodes import spline_basis
from dyngs.deform.field import MAX_KEY_TIMES, DeformationField
from dyngs.gaussians import Gaussians
from dyngs.ops.harmonics import light_harmonics
from dyngs.ops.quaternions import align_quat_signs

COARSE, FINE = 6, 8  # Cells along an edge of the cube that the sphere is divided by
GRID = 256  # Cubes along an edge of the table of the cells that directions point at
# Of a body in an image that are looked at, and that the first search looks at
MOST_PIXELS, FEWER_PIXELS = 250, 80
FEWEST_PIXELS = 50  # Of a body in an image, for that image to say how it turns
LEAST_PIXELS = 2  # In a cell, for its mean colour to count
# Squared colour differences: the greatest that counts, and that of cells never seen
CUT, UNKNOWN = 0.37, 0.13
WINDOW, FREE_DEG, GIVEN_DEG, STEP_DEG = 14, 200.0, 60.0, 30.0
"""Images that few numbers describe, and turns in that time that are tried: without another motion,
and added to one."""
LEAST_SEEN = 0.6  # Of the images of a window, for it to begin with
REFINED, ROUNDS, SAMPLES = 4, 4, 32
# Windows from which the rotation is followed; the one whose colours agree best in all is taken
FOLLOWED = 3
PACE = 3  # Images over which the rate is measured that the next is expected to turn at
FOLLOWED_DEG = (20.0, 5.0, 1e-4)
ROUNDS_DEG = ((10.0, 5.0, 1e-4), (5.0, 2.5, 2e-4), (3.0, 1.5, 2e-4))
"""Reach and step of the search around each image's rotation, and the weight of squared degrees from
what is expected: where it is followed, and in rounds at last."""

# of an image: (n, 3) unit normals in the world and (n, 3) colours
Frame = tuple[np.ndarray, np.ndarray]
Frames = Sequence[Frame]


@dataclass(frozen=True)
class BodyRotation:
    """Rotations of a body along its path, and mean squared differences of its colours in other
    images, cell by cell."""

    rotations: np.ndarray  # (T, 3, 3) body to world; the identity in the middle
    disagreement: float
    standing: float  # disagreement if the body did not turn
    by_chance: float  # disagreement of any two of its colours
    colors: np.ndarray  # (C, 3) mean colour of each of the ``FINE`` cells, light divided out
    counts: np.ndarray  # (C,) pixels that fell on it


def estimate_rotation(frame_stack: FrameStack, path: Path) -> BodyRotation:
    """Return how the body on ``path`` turns."""
    frames = without_light([_frame(frame_stack, path, t) for t in range(len(frame_stack))])
    starts = _windows(frames, _basis(frame_stack.times, path))
    static = np.broadcast_to(np.eye(3), (len(frames), 3, 3))
    rotations = static
    if starts:
        tried = np.stack([_polished(frames, _followed(frames, *start)) for start in starts])
        rotations = tried[disagreements(frames, tried).argmin()]
        rotations = rotations @ rotations[len(frames) // 2].T
    seen = np.sum([_sums(*both) for both in zip(frames, rotations, strict=True)], axis=0)
    moved, stood = disagreements(frames, np.stack([rotations, static]))
    every = np.concatenate([colors for _, colors in frames])
    by_chance = 2 * float(every.var(axis=0).sum()) if len(every) else 0.0
    return BodyRotation(rotations, float(moved), float(stood), by_chance, _means(seen).T, seen[3])


def _frame(frame_stack: FrameStack, path: Path, index: int) -> Frame:
    rows, columns, normals = frame_stack.ball_pixels(index, path.centers[index], path.radius)
    step = max(len(rows) // MOST_PIXELS, 1)
    return normals[::step], frame_stack.images[index, rows[::step], columns[::step]]


def without_light(frames: Frames) -> Frames:
    """Return the frames divided by the light: second-order harmonics of the normal in the world.

    Ramamoorthi and Hanrahan (2001): diffuse light has no finer detail. What turns averages out of
    the fit.
    """
    normals, colors = (np.concatenate(x) for x in zip(*frames, strict=True))
    if not len(normals):
        return frames
    light = np.linalg.lstsq(_harmonics(normals), colors, rcond=None)[0]
    usual = colors.mean(0)
    return [(n, c / np.clip(_harmonics(n) @ light, 0.15, 2.0) * usual) for n, c in frames]


def cells(normals: np.ndarray, size: int) -> np.ndarray:
    """Return (...) indices below 6 ``size``^2 of the cells of a cube that vectors (..., 3) point
    at."""
    axis = np.abs(normals).argmax(-1)
    along, first, second = (
        np.take_along_axis(normals, ((axis + k) % 3)[..., None], -1)[..., 0] for k in range(3)
    )
    face = 2 * axis + (along < 0)
    column, row = (
        np.clip(
            ((np.arctan(x / np.abs(along)) * 4 / np.pi + 1) / 2 * size).astype(int), 0, size - 1
        )
        for x in (first, second)
    )
    return (face * size + column) * size + row


@cache
def _table(size: int) -> np.ndarray:
    """Return the (``GRID``^3,) cells of a grid of cubes around the origin, where the unit sphere
    cuts these."""
    side = np.arange(GRID, dtype=np.float32) + 0.5 - GRID / 2
    away = np.sqrt(side[:, None, None] ** 2 + side[:, None] ** 2 + side**2)
    cut = np.nonzero(np.abs(away - GRID / 2) < 1)
    found = np.zeros((GRID, GRID, GRID), np.int16)
    found[cut] = cells(side[np.stack(cut, axis=1)], size)
    return found.ravel()


def turned_cells(rotations: np.ndarray, normals: np.ndarray, size: int) -> np.ndarray:
    """Return the (H, n) cells of bodies at ``rotations`` (H, 3, 3) that ``normals`` (n, 3) in the
    world point at.

    From a table: the borders of cells are rough by 1 / ``GRID``, alike for all, at a tenth of the
    cost of ``cells``.
    """
    ways = np.swapaxes(rotations, 1, 2).reshape(-1, 3).astype(np.float32) @ normals.T.astype(
        np.float32
    )
    ways = np.floor((0.4999 * GRID) * ways + GRID / 2).reshape(len(rotations), 3, len(normals))
    x, y, z = np.moveaxis(ways, 1, 0)
    return _table(size).take(((x * GRID + y) * GRID + z).astype(np.intp))


def disagreements(frames: Frames, rotations: np.ndarray) -> np.ndarray:
    """Return for ``rotations`` (H, T, 3, 3) the (H,) mean squared differences of colours that fall
    on the same cell.

    Over all pairs of images that show a cell; hypotheses with few such pairs score 9.
    """
    count = len(rotations)
    cells_all = 6 * COARSE**2
    first = (np.arange(count) * cells_all)[:, None]
    whole = count * cells_all
    sums = np.zeros((3, whole))
    squares = np.zeros(whole)
    shown = np.zeros(whole)  # over images, of means of cells
    for t, (normals, colors) in enumerate(frames):
        if not len(normals):
            continue
        place = (turned_cells(rotations[:, t], normals, COARSE) + first).ravel()
        pixels = np.bincount(place, minlength=whole)
        counts = pixels >= LEAST_PIXELS
        shown += counts
        parts = counts / np.maximum(pixels, 1)
        for of_channel, channel in zip(sums, colors.T, strict=True):
            means = (
                np.bincount(place, np.broadcast_to(channel, (count, len(channel))).ravel(), whole)
                * parts
            )
            of_channel += means
            squares += means**2
    pairs = (shown * (shown - 1) / 2).reshape(count, -1).sum(1)
    apart = np.where(shown > 1, squares * shown - (sums**2).sum(0), 0).reshape(count, -1).sum(1)
    return np.where(pairs > 0.4 * np.median(pairs), apart / np.maximum(pairs, 1), 9.0)


def rotations_by(vectors: np.ndarray) -> np.ndarray:
    """Return (..., 3, 3) rotations about the vectors (..., 3) by their lengths, radians."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def angles_deg(rotations: np.ndarray) -> np.ndarray:
    """Return (...) angles of rotations (..., 3, 3)."""
    return np.degrees(np.arccos(np.clip((np.trace(rotations, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))


def integrated(numbers: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Return (H, T, 3, 3) rotations, the identity in the middle, for ``numbers`` (H, B) of
    ``basis`` (B, T - 1, 3)."""
    steps = rotations_by(np.tensordot(numbers, basis, 1))
    found = np.empty((len(steps), steps.shape[1] + 1, 3, 3))
    found[:, 0] = np.eye(3)
    for t in range(steps.shape[1]):
        found[:, t + 1] = steps[:, t] @ found[:, t]
    return found @ np.swapaxes(found[:, None, found.shape[1] // 2], -1, -2)


def _basis(times: np.ndarray, path: Path) -> np.ndarray:
    """Return (5, T - 1, 3) turns from image to image, radians in the world.

    Rolling on the plane of the path, turning with the path's direction, and one radian per clip
    about each axis.
    """
    centers = path.centers
    gaps = np.diff(times)[:, None]
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
    """Return the first image of the windows that colours agree best in, and (W, 3, 3) rotations
    there."""
    steps = [max(len(normals) // FEWER_PIXELS, 1) for normals, _ in frames]
    thin = [
        (n[t % k :: k], c[t % k :: k])
        for t, ((n, c), k) in enumerate(zip(frames, steps, strict=True))
    ]
    size = min(WINDOW, len(frames))
    found = []
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
    """Return the disagreement and the (5,) numbers with which it is least: a grid, then random
    steps from the best."""

    def score(numbers: np.ndarray) -> np.ndarray:
        parts = np.split(numbers, range(64, len(numbers), 64))
        return np.concatenate([disagreements(frames, integrated(part, basis)) for part in parts])

    tried: list[tuple[float, np.ndarray]] = []
    for given in ((0, 0), (1, 0), (-1, 0), (0, 1)):
        free = np.radians(_ball_of(GIVEN_DEG if any(given) else FREE_DEG, STEP_DEG))
        numbers = np.concatenate([np.tile(given, (len(free), 1)), free], axis=1).astype(float)
        scores = score(numbers)
        tried += [(float(scores[i]), numbers[i]) for i in np.argsort(scores, kind="stable")[:3]]
    random = np.random.default_rng(0)
    found = []
    for best, numbers in sorted(tried, key=lambda x: x[0])[:REFINED]:
        spread = np.array([0.1, 0.1, 0.3, 0.3, 0.3]) * np.where(
            np.arange(5) < 2, numbers != 0, True
        )
        for _ in range(ROUNDS):
            around = numbers + random.normal(size=(SAMPLES, 5)) * spread
            scores = score(around)
            if scores.min() < best:
                best = float(scores.min())
                numbers = around[scores.argmin()]
            else:
                spread = 0.6 * spread
            spread = 0.85 * spread
        found.append((best, numbers))
    return min(found, key=lambda x: x[0])


def _followed(frames: Frames, first: int, known: np.ndarray) -> np.ndarray:
    """Return (T, 3, 3) rotations: those ``known`` (W, 3, 3) from image ``first`` on, polished, and
    followed from there.

    Each image is searched around where the last ones' rate takes it, against the colours of all
    before it.
    """
    from scipy.spatial.transform import Rotation

    reach, step, pull = FOLLOWED_DEG
    around = rotations_by(np.radians(_ball_of(reach, step)))
    high = first + len(known) - 1
    pulls = pull * angles_deg(around) ** 2
    rotations = np.broadcast_to(np.eye(3), (len(frames), 3, 3)).copy()
    rotations[first : high + 1] = _polished(frames[first : high + 1], known)
    seen = np.sum([_sums(frames[t], rotations[t]) for t in range(first, high + 1)], axis=0)
    pace = min(PACE, len(known) - 1)
    outside = [t for t in range(len(frames)) if not first <= t <= high]
    for t in sorted(outside, key=lambda t: (abs(2 * t - first - high), -t)):
        way = 1 if t > high else -1
        last = rotations[t - way]
        rate = Rotation.from_matrix(last @ rotations[t - (1 + pace) * way].T).as_rotvec() / pace
        expected = rotations_by(rate) @ last
        rotations[t] = _best_of(frames[t], around, expected, seen, pulls)
        seen = seen + _sums(frames[t], rotations[t])
    return rotations


def _best_of(
    frame: Frame, around: np.ndarray, center: np.ndarray, seen: np.ndarray, pull: np.ndarray
) -> np.ndarray:
    """Return which of ``around`` (H, 3, 3) after ``center`` agrees best with what is ``seen``, less
    ``pull`` (H,)."""
    normals, colors = frame
    if len(normals) < FEWEST_PIXELS:
        return center
    tried = around @ center
    place = turned_cells(tried, normals, FINE)
    apart = np.minimum(
        sum((mean.take(place) - c) ** 2 for mean, c in zip(_means(seen), colors.T, strict=True)),
        CUT,
    )
    return tried[
        np.argmin(np.where((seen[3] >= LEAST_PIXELS).take(place), apart, UNKNOWN).mean(1) + pull)
    ]


def _polished(frames: Frames, rotations: np.ndarray) -> np.ndarray:
    """Return ``rotations`` (T, 3, 3), each moved to where its image agrees best with the map of all
    the others."""
    found = rotations.copy()
    for reach, step, pull in ROUNDS_DEG:
        around = rotations_by(np.radians(_ball_of(reach, step)))
        own = np.stack([_sums(*both) for both in zip(frames, found, strict=True)])
        seen = own.sum(0)
        for t, frame in enumerate(frames):
            expected = found[t]
            if 0 < t < len(frames) - 1:
                u, _, v = np.linalg.svd(found[t - 1] + found[t + 1])
                expected = u @ v  # halfway: the rotation nearest to the sum
            seen = seen - own[t]
            if len(frame[0]) < FEWEST_PIXELS:
                found[t] = expected
            else:
                bend = angles_deg(around @ (found[t] @ expected.T))
                found[t] = _best_of(frame, around, found[t], seen, pull * bend**2)
            seen = seen + _sums(frame, found[t])
    return found


def _sums(frame: Frame, rotation: np.ndarray) -> np.ndarray:
    """Return the (4, C) sums of colours that fall on the cells of the body's sphere, and numbers of
    pixels."""
    normals, colors = frame
    (place,), count = turned_cells(rotation[None], normals, FINE), 6 * FINE**2
    return np.stack(
        [np.bincount(place, channel, count) for channel in (*colors.T, np.ones(len(place)))]
    )


def _means(seen: np.ndarray) -> np.ndarray:
    """Return the (3, C) mean colours of what is ``seen`` (4, C)."""
    return seen[:3] / np.maximum(seen[3], 1)


def _ball_of(reach: float, step: float) -> np.ndarray:
    """Return the (H, 3) points of a grid in a ball."""
    side = np.arange(-reach, reach + 1e-6, step)
    grid = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(-1, 3)
    return grid[np.linalg.norm(grid, axis=1) <= reach + 1e-6]


def _harmonics(normals: np.ndarray) -> np.ndarray:
    """Return (n, 9) polynomials of unit vectors that span the harmonics up to order 2."""
    return torch.nn.functional.pad(
        light_harmonics(torch.from_numpy(normals)), (1, 0), value=1.0
    ).numpy()


AGREES, BY_CHANCE = 0.6, 0.4
"""Disagreement of a body's colours, as a fraction of that if it did not turn, and of that of any of
its colours.

Balls that roll have 0.16 to 0.47 of the former. A die, for which the ball is a poor model, has
0.75, be its rotation 5 degrees off or 26, where following it cost 1.5 dB."""
# Disagreement of any of its colours below which these say nothing about how it turns
LEAST_MARKS = 0.04
SMALLEST = 32  # Sides of images, in pixels, that may tell how something turns
# That are sought, and paths that may prove to be none before the search ends
MOST_BODIES, MOST_REFUSED = 6, 4
INNER, LOGIT, SCALE = 0.7, 0.0, 0.6
"""Of the Gaussians that begin on a body: least distance from its centre in radii, opacity, and size
in distances."""
MARKED, LEFT = 0.35, 0.3
"""Mean difference of 5x5 pixels that shows motion for sure, and the part of all such that bodies
need not explain."""
PIECES_PER_TIME = 0.35
PX_PER_SEED = 2.0  # Area of the surface in pixels
STIFFNESS = 0.1


@dataclass(frozen=True)
class RigidBody:
    """A thing that moves rigidly over the times of T images."""

    path: Path
    rotation: BodyRotation


@dataclass(frozen=True)
class Bodies:
    """Bodies that were found, and how they were seen."""

    frame_stack: FrameStack
    bodies: tuple[RigidBody, ...]
    seeds: tuple[Gaussians, ...]  # of each, where it is in the middle of the clip

    @property
    def message(self) -> str:
        """A line about them."""
        from scipy.spatial.transform import Rotation

        turns = [Rotation.from_matrix(body.rotation.rotations) for body in self.bodies]
        turns = [np.degrees((turn[1:] * turn[:-1].inv()).magnitude()).sum() for turn in turns]
        things = "1 body turns" if len(turns) == 1 else f"{len(turns)} bodies turn"
        clip = (
            "followed at all times at once"
            if self.explains_all_motion
            else "other things move, too"
        )
        return f"{things} by {', '.join(f'{turn:.0f}' for turn in turns)} degrees; {clip}"

    @cached_property
    def explains_all_motion(self) -> bool:
        """Whether hardly anything else moves."""
        from scipy.ndimage import uniform_filter

        maps = self.frame_stack.differences()
        marked = maps * (uniform_filter(maps, 5, axes=(1, 2)) > MARKED)
        whole = float(marked.sum())
        for body in self.bodies:
            clear_path_(marked, self.frame_stack, body.path)
        return float(marked.sum()) < LEFT * whole

    def within(self, inner_field: DeformationField) -> BodyField:
        """Return the field of ``others`` in which the last of the moving Gaussians, the seeds, are
        the bodies'."""
        num_pieces = min(max(round(PIECES_PER_TIME * len(self.frame_stack)), 1), MAX_KEY_TIMES)
        basis = spline_basis(torch.from_numpy(self.frame_stack.times), num_pieces).numpy()
        splines = {
            "places": [_fitted(basis, body.path.centers) for body in self.bodies],
            "quats": [_fitted(basis, _quats(body.rotation.rotations)) for body in self.bodies],
        }
        centers = np.stack([body.path.centers[len(self.frame_stack) // 2] for body in self.bodies])
        counts = [len(seeds) for seeds in self.seeds]
        labels = torch.repeat_interleave(
            torch.tensor([inner_field.setup.num_moving - sum(counts), *counts], device="cpu")
        )
        device = inner_field.setup.center.device
        points = {
            name: torch.from_numpy(np.stack(x)).float().to(device) for name, x in splines.items()
        }
        radii = torch.tensor([body.path.radius for body in self.bodies], device=device)
        rest = BodyRestPose(
            torch.from_numpy(centers).float().to(device), radii, (labels - 1).to(device)
        )
        albedo = torch.cat([seeds.sh[:, 0] + 0.5 / SH_C0 for seeds in self.seeds]).to(device)
        albedo = torch.cat([albedo.new_zeros(len(labels) - len(albedo), 3), albedo])
        # of the cameras
        up = torch.from_numpy(-self.frame_stack.poses[:, 1, :3].mean(0)).float().to(device)
        return BodyField(inner_field, rest, points | {"albedo": albedo, "sun": up})


def find_bodies(frame_stack: FrameStack, limit: int, num_terms: int) -> Bodies | None:
    """Return what moves rigidly, with at most ``limit`` Gaussians of ``num_terms`` harmonics; None
    where nothing does.

    A body is taken if the colours of its surface, each compared with other images, agree clearly
    better than if it did not turn, and than by chance: what bends shows other colours in the same
    direction.
    """
    bodies = _rigid_bodies(frame_stack) if limit and min(frame_stack.size) >= SMALLEST else ()
    if not bodies or limit < len(bodies):
        return None
    return Bodies(
        frame_stack,
        bodies,
        tuple(_seeds(body, frame_stack, limit // len(bodies), num_terms) for body in bodies),
    )


def _rigid_bodies(frame_stack: FrameStack) -> tuple[RigidBody, ...]:
    """Return what moves rigidly; each is taken out before the next is sought, and what hides others
    where none is."""
    maps = frame_stack.differences()
    bodies = []
    refused = []
    while len(bodies) < MOST_BODIES and len(refused) < MOST_REFUSED:
        paths = find_paths(frame_stack, maps)
        if not paths:
            break
        fresh = [path for path in paths if not any(path.is_like(other) for other in refused)]
        for path in fresh[: MOST_REFUSED - len(refused)]:
            body = RigidBody(path, estimate_rotation(frame_stack, path))
            if _is_rigid(body.rotation):
                bodies.append(body)
                clear_path_(maps, frame_stack, path)
                break
            refused.append(path)
        else:
            clear_path_(maps, frame_stack, paths[0])
    return tuple(bodies)


def _is_rigid(rotation: BodyRotation) -> bool:
    least = min(AGREES * rotation.standing, BY_CHANCE * rotation.by_chance)
    return rotation.by_chance >= LEAST_MARKS and rotation.disagreement < least


def _seeds(body: RigidBody, frame_stack: FrameStack, limit: int, num_terms: int) -> Gaussians:
    middle = len(frame_stack) // 2
    random = np.random.default_rng(0)
    radius = body.path.radius
    _, depths = frame_stack.project(np.arange(len(frame_stack)), body.path.centers)
    pixels = 4 * np.pi * float(np.median(radius * frame_stack.focal / depths)) ** 2
    count = min(limit, max(int(pixels / PX_PER_SEED), 1))
    ways = random.normal(size=(count, 3))
    ways = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    away = radius * random.uniform(INNER, 1.0, size=(count, 1))
    usual = body.rotation.colors[body.rotation.counts > 0].mean(0)
    place = cells(ways, FINE)
    colors = np.where(body.rotation.counts[place, None] > 0, body.rotation.colors[place], usual)
    base = torch.from_numpy((colors - 0.5) / SH_C0).float()
    spacing = radius * math.sqrt(4 * math.pi / count)
    means = torch.from_numpy(body.path.centers[middle] + away * ways).float()
    return Gaussians.isotropic(means, math.log(SCALE * spacing), LOGIT, base, num_terms)


def _quats(rotations: np.ndarray) -> np.ndarray:
    """Return (T, 4) quaternions wxyz of ``rotations`` (T, 3, 3), each on the side of the one
    before."""
    from scipy.spatial.transform import Rotation

    return align_quat_signs(Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]])


def _fitted(basis: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the (P, D) control points nearest to ``values`` (T, D), with small second
    differences."""
    bends = STIFFNESS**0.5 * np.diff(np.eye(basis.shape[1]), n=2, axis=0)
    right = np.concatenate([values, np.zeros((len(bends), values.shape[1]))])
    return np.linalg.lstsq(np.concatenate([basis, bends]), right, rcond=None)[0]
