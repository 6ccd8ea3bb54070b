"""Rigid bodies: their rotations along a path, estimated from the colours of their surfaces.

Given a hypothesis of the rotations, every pixel maps to a direction in the body frame. Colours
that fall on the same cell in several images must agree once shading is divided out. First, windows
of a few images are searched over few parameters: a constant rotation rate, alone or added to
rolling on the plane of the path or to turning with its direction. From the best windows the
rotation is tracked image by image in both directions. Finally every image is refined against all
others.

Local letters: T images, H hypotheses, n pixels, C cells of the sphere, B basis motions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import torch
from torch import Tensor

from dyngs.core.conventions import SH_C0
from dyngs.deform.bodies.field import BodyField, BodyRestPose
from dyngs.deform.bodies.paths import FrameStack, Path, clear_path_, find_paths
from dyngs.deform.control_nodes import spline_basis
from dyngs.deform.field import MAX_KEY_TIMES, DeformationField
from dyngs.gaussians import Gaussians
from dyngs.ops.harmonics import light_harmonics
from dyngs.ops.quaternions import align_quat_signs

COARSE, FINE = 6, 8  # cells along an edge of the cube map
GRID = 256  # cells along an edge of the lookup table of directions
# Pixels per body and image that are used, and in the first search.
MOST_PIXELS, FEWER_PIXELS = 250, 80
FEWEST_PIXELS = 50  # pixels that an image needs to determine the rotation
LEAST_PIXELS = 2  # pixels that a cell needs for a mean colour
# Squared colour differences: upper limit, and value of unobserved cells.
CUT, UNKNOWN = 0.37, 0.13
WINDOW, FREE_DEG, GIVEN_DEG, STEP_DEG = 14, 200.0, 60.0, 30.0
"""Images per window, and rotations searched in it: without and with a prior motion, and grid step.
"""
LEAST_SEEN = 0.6  # fraction of the images of a window that must show the body
REFINED, ROUNDS, SAMPLES = 4, 4, 32
# Windows from which tracking starts; the one with the best agreement is used.
FOLLOWED = 3
PACE = 3  # images over which the rotation rate is measured for prediction
FOLLOWED_DEG = (20.0, 5.0, 1e-4)
ROUNDS_DEG = ((10.0, 5.0, 1e-4), (5.0, 2.5, 2e-4), (3.0, 1.5, 2e-4))
"""Radius and step of the search around the prediction, and weight of squared degrees from it: in
tracking, and in the refinement rounds."""

# One image of a body: unit normals (n, 3), world, and colours (n, 3).
Frame = tuple[np.ndarray, np.ndarray]
Frames = Sequence[Frame]


@dataclass(frozen=True)
class BodyRotation:
    """Rotations of a body along its path, and the disagreement of its colours between images.

    The disagreement is the mean squared colour difference per cell.
    """

    rotations: np.ndarray  # (T, 3, 3) world from body; the identity in the middle image
    disagreement: float
    disagreement_without_rotation: float  # disagreement without rotation
    random_disagreement: float  # disagreement of random pairs of its colours
    colors: np.ndarray  # (C, 3) mean colour of each of the ``FINE`` cells, without shading
    counts: np.ndarray  # (C,) pixels per cell


def estimate_rotation(frame_stack: FrameStack, path: Path) -> BodyRotation:
    """Estimate the rotations of the body on ``path``."""
    frames = divide_by_shading([_body_frame(frame_stack, path, t) for t in range(len(frame_stack))])
    starts = _search_windows(frames, _rotation_basis(frame_stack.times, path))
    static = np.broadcast_to(np.eye(3), (len(frames), 3, 3))
    rotations = static
    if starts:
        tried = np.stack([_refine(frames, _track_rotation(frames, *start)) for start in starts])
        rotations = tried[disagreements(frames, tried).argmin()]
        rotations = rotations @ rotations[len(frames) // 2].T
    seen = np.sum([_colour_sums(*both) for both in zip(frames, rotations, strict=True)], axis=0)
    rotated, unrotated = disagreements(frames, np.stack([rotations, static]))
    all_colors = np.concatenate([colors for _, colors in frames])
    random_disagreement = 2 * float(all_colors.var(axis=0).sum()) if len(all_colors) else 0.0
    return BodyRotation(
        rotations,
        float(rotated),
        float(unrotated),
        random_disagreement,
        _mean_colours(seen).T,
        seen[3],
    )


def _body_frame(frame_stack: FrameStack, path: Path, index: int) -> Frame:
    rows, columns, normals = frame_stack.ball_pixels(index, path.centers[index], path.radius)
    step = max(len(rows) // MOST_PIXELS, 1)
    return normals[::step], frame_stack.images[index, rows[::step], columns[::step]]


def divide_by_shading(frames: Frames) -> Frames:
    """Divide the frames by their shading: second-order harmonics of the normal.

    Diffuse light has no finer detail (Ramamoorthi and Hanrahan 2001). Texture that rotates
    averages out of the fit.
    """
    normals, colors = (np.concatenate(x) for x in zip(*frames, strict=True))
    if not len(normals):
        return frames
    light = np.linalg.lstsq(_harmonics(normals), colors, rcond=None)[0]
    mean_color = colors.mean(0)
    return [(n, c / np.clip(_harmonics(n) @ light, 0.15, 2.0) * mean_color) for n, c in frames]


def cells(normals: np.ndarray, size: int) -> np.ndarray:
    """Return cube map cells (...), below 6 ``size``^2, that the vectors (..., 3) point at."""
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
    """Return a lookup table (``GRID``^3,) of cells for directions on the unit sphere."""
    side = np.arange(GRID, dtype=np.float32) + 0.5 - GRID / 2
    away = np.sqrt(side[:, None, None] ** 2 + side[:, None] ** 2 + side**2)
    cut = np.nonzero(np.abs(away - GRID / 2) < 1)
    table = np.zeros((GRID, GRID, GRID), np.int16)
    table[cut] = cells(side[np.stack(cut, axis=1)], size)
    return table.ravel()


def rotated_cells(rotations: np.ndarray, normals: np.ndarray, size: int) -> np.ndarray:
    """Return the cells (H, n) that ``normals`` (n, 3) fall on with ``rotations`` (H, 3, 3).

    Uses a lookup table: a tenth of the cost of ``cells``, with cell borders rounded to 1 /
    ``GRID``.
    """
    ways = np.swapaxes(rotations, 1, 2).reshape(-1, 3).astype(np.float32) @ normals.T.astype(
        np.float32
    )
    ways = np.floor((0.4999 * GRID) * ways + GRID / 2).reshape(len(rotations), 3, len(normals))
    x, y, z = np.moveaxis(ways, 1, 0)
    return _table(size).take(((x * GRID + y) * GRID + z).astype(np.intp))


def disagreements(frames: Frames, rotations: np.ndarray) -> np.ndarray:
    """Return the mean squared colour differences (H,) per cell for ``rotations`` (H, T, 3, 3).

    Over all pairs of images that show a cell; hypotheses with few pairs score 9.
    """
    count = len(rotations)
    cells_all = 6 * COARSE**2
    first = (np.arange(count) * cells_all)[:, None]
    whole = count * cells_all
    sums = np.zeros((3, whole))
    squares = np.zeros(whole)
    shown = np.zeros(whole)  # number of images per cell
    for t, (normals, colors) in enumerate(frames):
        if not len(normals):
            continue
        place = (rotated_cells(rotations[:, t], normals, COARSE) + first).ravel()
        pixels = np.bincount(place, minlength=whole)
        counts = pixels >= LEAST_PIXELS
        shown += counts
        parts = counts / np.maximum(pixels, 1)
        for of_channel, channel in zip(sums, colors.T, strict=True):
            means = np.bincount(place, np.tile(channel, count), whole) * parts
            of_channel += means
            squares += means**2
    pairs = (shown * (shown - 1) / 2).reshape(count, -1).sum(1)
    apart = np.where(shown > 1, squares * shown - (sums**2).sum(0), 0).reshape(count, -1).sum(1)
    return np.where(pairs > 0.4 * np.median(pairs), apart / np.maximum(pairs, 1), 9.0)


def rotations_from_vectors(vectors: np.ndarray) -> np.ndarray:
    """Return rotations (..., 3, 3) of the rotation vectors (..., 3), radians."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def angles_deg(rotations: np.ndarray) -> np.ndarray:
    """Return the angles (...) of rotations (..., 3, 3), degrees."""
    return np.degrees(np.arccos(np.clip((np.trace(rotations, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))


def integrate_rotations(numbers: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Integrate rotation rates; return rotations (H, T, 3, 3), the identity in the middle image.

    ``numbers`` (H, B): coefficients of ``basis`` (B, T - 1, 3).
    """
    steps = rotations_from_vectors(np.tensordot(numbers, basis, 1))
    rotations = np.empty((len(steps), steps.shape[1] + 1, 3, 3))
    rotations[:, 0] = np.eye(3)
    for t in range(steps.shape[1]):
        rotations[:, t + 1] = steps[:, t] @ rotations[:, t]
    return rotations @ np.swapaxes(rotations[:, None, rotations.shape[1] // 2], -1, -2)


def _rotation_basis(times: np.ndarray, path: Path) -> np.ndarray:
    """Return basis rotation steps (5, T - 1, 3) from image to image, radians, world.

    Rolling on the plane of the path, turning with its direction, and one radian per clip about
    each axis.
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


def _search_windows(frames: Frames, basis: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Return the windows with the best agreement: first image and rotations (W, 3, 3)."""
    steps = [max(len(normals) // FEWER_PIXELS, 1) for normals, _ in frames]
    thin = [
        (n[t % k :: k], c[t % k :: k])
        for t, ((n, c), k) in enumerate(zip(frames, steps, strict=True))
    ]
    size = min(WINDOW, len(frames))
    windows = []
    last = len(frames) - size
    for first in sorted({*range(0, last + 1, max(size - 1, 1)), last}):
        part = thin[first : first + size]
        if np.mean([len(normals) >= FEWEST_PIXELS for normals, _ in part]) < LEAST_SEEN:
            continue
        turns = basis[:, first : first + size - 1].copy()
        turns[2:] /= turns[2:].sum(1).max()
        score, numbers = _minimise(part, turns)
        variance = float(np.concatenate([colors for _, colors in part]).var(axis=0).sum())
        rotations = integrate_rotations(numbers[None], turns)[0]
        windows.append((score / max(variance, 1e-6), first, rotations))
    return [start[1:] for start in sorted(windows, key=lambda start: start[:2])[:FOLLOWED]]


def _minimise(frames: Frames, basis: np.ndarray) -> tuple[float, np.ndarray]:
    """Minimise the disagreement over the coefficients (5,): grid search, then random steps."""

    def score(numbers: np.ndarray) -> np.ndarray:
        parts = np.split(numbers, range(64, len(numbers), 64))
        return np.concatenate(
            [disagreements(frames, integrate_rotations(part, basis)) for part in parts]
        )

    tried: list[tuple[float, np.ndarray]] = []
    for given in ((0, 0), (1, 0), (-1, 0), (0, 1)):
        free = np.radians(_ball_grid(GIVEN_DEG if any(given) else FREE_DEG, STEP_DEG))
        numbers = np.concatenate([np.tile(given, (len(free), 1)), free], axis=1).astype(float)
        scores = score(numbers)
        tried += [(float(scores[i]), numbers[i]) for i in np.argsort(scores, kind="stable")[:3]]
    random = np.random.default_rng(0)
    minima = []
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
        minima.append((best, numbers))
    return min(minima, key=lambda x: x[0])


def _track_rotation(frames: Frames, first: int, known: np.ndarray) -> np.ndarray:
    """Extend ``known`` rotations (W, 3, 3) from image ``first`` on to all images (T, 3, 3).

    Each image is searched around the constant-rate prediction, against the colours of all earlier
    ones.
    """
    from scipy.spatial.transform import Rotation

    reach, step, pull = FOLLOWED_DEG
    around = rotations_from_vectors(np.radians(_ball_grid(reach, step)))
    high = first + len(known) - 1
    pulls = pull * angles_deg(around) ** 2
    rotations = np.broadcast_to(np.eye(3), (len(frames), 3, 3)).copy()
    rotations[first : high + 1] = _refine(frames[first : high + 1], known)
    seen = np.sum([_colour_sums(frames[t], rotations[t]) for t in range(first, high + 1)], axis=0)
    pace = min(PACE, len(known) - 1)
    outside = [t for t in range(len(frames)) if not first <= t <= high]
    for t in sorted(outside, key=lambda t: (abs(2 * t - first - high), -t)):
        way = 1 if t > high else -1
        last = rotations[t - way]
        rate = Rotation.from_matrix(last @ rotations[t - (1 + pace) * way].T).as_rotvec() / pace
        expected = rotations_from_vectors(rate) @ last
        rotations[t] = _best_candidate(frames[t], around, expected, seen, pulls)
        seen = seen + _colour_sums(frames[t], rotations[t])
    return rotations


def _best_candidate(
    frame: Frame, around: np.ndarray, center: np.ndarray, seen: np.ndarray, pull: np.ndarray
) -> np.ndarray:
    """Return the candidate of ``around`` (H, 3, 3) times ``center`` with the best agreement.

    ``seen``: colour sums of the other images. ``pull`` (H,): penalty of each candidate.
    """
    normals, colors = frame
    if len(normals) < FEWEST_PIXELS:
        return center
    tried = around @ center
    place = rotated_cells(tried, normals, FINE)
    differences = _mean_colours(seen).T[place] - colors
    apart = np.minimum((differences**2).sum(2), CUT)
    is_known = (seen[3] >= LEAST_PIXELS)[place]
    return tried[np.argmin(np.where(is_known, apart, UNKNOWN).mean(1) + pull)]


def _refine(frames: Frames, rotations: np.ndarray) -> np.ndarray:
    """Refine ``rotations`` (T, 3, 3), each against the colour map of all other images."""
    refined = rotations.copy()
    for reach, step, pull in ROUNDS_DEG:
        around = rotations_from_vectors(np.radians(_ball_grid(reach, step)))
        own = np.stack([_colour_sums(*both) for both in zip(frames, refined, strict=True)])
        seen = own.sum(0)
        for t, frame in enumerate(frames):
            expected = refined[t]
            if 0 < t < len(frames) - 1:
                u, _, v = np.linalg.svd(refined[t - 1] + refined[t + 1])
                expected = u @ v  # rotation nearest to the mean of both neighbours
            seen = seen - own[t]
            if len(frame[0]) < FEWEST_PIXELS:
                refined[t] = expected
            else:
                bend = angles_deg(around @ (refined[t] @ expected.T))
                refined[t] = _best_candidate(frame, around, refined[t], seen, pull * bend**2)
            seen = seen + _colour_sums(frame, refined[t])
    return refined


def _colour_sums(frame: Frame, rotation: np.ndarray) -> np.ndarray:
    """Return colour sums and pixel counts (4, C) per cell of the body's sphere."""
    normals, colors = frame
    (place,), count = rotated_cells(rotation[None], normals, FINE), 6 * FINE**2
    return np.stack(
        [np.bincount(place, channel, count) for channel in (*colors.T, np.ones(len(place)))]
    )


def _mean_colours(seen: np.ndarray) -> np.ndarray:
    """Return the mean colours (3, C) of sums (4, C)."""
    return seen[:3] / np.maximum(seen[3], 1)


def _ball_grid(reach: float, step: float) -> np.ndarray:
    """Return grid points (H, 3) inside a ball of radius ``reach``."""
    side = np.arange(-reach, reach + 1e-6, step)
    grid = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(-1, 3)
    return grid[np.linalg.norm(grid, axis=1) <= reach + 1e-6]


def _harmonics(normals: np.ndarray) -> np.ndarray:
    """Return polynomials (n, 9) of unit vectors that span the harmonics up to degree 2."""
    return torch.nn.functional.pad(
        light_harmonics(torch.from_numpy(normals)), (1, 0), value=1.0
    ).numpy()


MAX_RELATIVE_DISAGREEMENT, MAX_RANDOM_FRACTION = 0.6, 0.4
"""Largest disagreement of a rigid body, relative to no rotation and to random colour pairs.

Rolling balls have 0.16 to 0.47 of the former; a die, for which a ball is a poor model, 0.75.
"""
# Least disagreement of random colour pairs: below, the texture does not determine the rotation.
MIN_TEXTURE = 0.04
SMALLEST = 32  # shortest image side in pixels for the search
# Most bodies, and most rejected paths before the search ends.
MAX_BODIES, MAX_REJECTED = 6, 4
INNER, LOGIT, SCALE = 0.7, 0.0, 0.6
"""Initial Gaussians of a body: least distance from its centre in radii, opacity logit, and scale
in distances between them."""
MOTION_RESIDUAL, UNEXPLAINED_FRACTION = 0.35, 0.3
"""Mean residual of 5x5 pixels that certainly shows motion, and fraction of it that bodies need not
explain."""
PIECES_PER_TIME = 0.35
PX_PER_GAUSSIAN = 2.0  # surface area per initial Gaussian, pixels
STIFFNESS = 0.1


@dataclass(frozen=True)
class RigidBody:
    """A rigid body at T times."""

    path: Path
    rotation: BodyRotation


@dataclass(frozen=True)
class Bodies:
    """Rigid bodies and the images in which they were detected."""

    frame_stack: FrameStack
    bodies: tuple[RigidBody, ...]
    seeds: tuple[Gaussians, ...]  # initial Gaussians of each body, posed at the middle of the clip

    @property
    def message(self) -> str:
        """Log message about the bodies."""
        from scipy.spatial.transform import Rotation

        turns = [Rotation.from_matrix(body.rotation.rotations) for body in self.bodies]
        turns = [np.degrees((turn[1:] * turn[:-1].inv()).magnitude()).sum() for turn in turns]
        things = "1 rigid body" if len(turns) == 1 else f"{len(turns)} rigid bodies"
        clip = "nothing else moves" if self.explains_all_motion else "other parts move, too"
        angles = ", ".join(f"{turn:.0f}" for turn in turns)
        return f"found {things} rotating by {angles} degrees; {clip}"

    @cached_property
    def explains_all_motion(self) -> bool:
        """True if nearly all motion belongs to the bodies."""
        from scipy.ndimage import uniform_filter

        maps = self.frame_stack.differences()
        marked = maps * (uniform_filter(maps, 5, axes=(1, 2)) > MOTION_RESIDUAL)
        whole = float(marked.sum())
        for body in self.bodies:
            clear_path_(marked, self.frame_stack, body.path)
        return float(marked.sum()) < UNEXPLAINED_FRACTION * whole

    def build_field(self, inner_field: DeformationField) -> BodyField:
        """Build the body field around ``inner_field``; the bodies own the last moving Gaussians."""
        num_pieces = min(max(round(PIECES_PER_TIME * len(self.frame_stack)), 1), MAX_KEY_TIMES)
        basis = spline_basis(torch.from_numpy(self.frame_stack.times), num_pieces).numpy()
        device = inner_field.setup.center.device

        def tensor(values: Sequence[np.ndarray | float]) -> Tensor:
            return torch.from_numpy(np.stack(values)).float().to(device)

        learned = {
            "places": tensor([_fit_spline(basis, x.path.centers) for x in self.bodies]),
            "quats": tensor(
                [_fit_spline(basis, _quats(x.rotation.rotations)) for x in self.bodies]
            ),
        }
        middle = len(self.frame_stack) // 2
        centers = tensor([x.path.centers[middle] for x in self.bodies])
        radii = tensor([x.path.radius for x in self.bodies])
        counts = [len(seeds) for seeds in self.seeds]
        labels = torch.repeat_interleave(
            torch.tensor([inner_field.setup.num_moving - sum(counts), *counts], device="cpu")
        )
        rest = BodyRestPose(centers, radii, (labels - 1).to(device))
        albedo = torch.cat([seeds.sh[:, 0] + 0.5 / SH_C0 for seeds in self.seeds]).to(device)
        albedo = torch.cat([albedo.new_zeros(len(labels) - len(albedo), 3), albedo])
        # up direction of the cameras
        up = tensor(list(-self.frame_stack.poses[:, 1, :3].mean(0)))
        return BodyField(inner_field, rest, learned | {"albedo": albedo, "sun": up})


def find_bodies(frame_stack: FrameStack, limit: int, num_terms: int) -> Bodies | None:
    """Find rigid bodies with at most ``limit`` Gaussians of ``num_terms`` SH coefficients; None if
    none.

    A path is a rigid body if its surface colours agree clearly better between images than without
    rotation, and better than random pairs. Deforming objects show other colours in the same
    direction.
    """
    bodies = _find_rigid_bodies(frame_stack) if limit and min(frame_stack.size) >= SMALLEST else ()
    if not bodies or limit < len(bodies):
        return None
    return Bodies(
        frame_stack,
        bodies,
        tuple(
            _initial_gaussians(body, frame_stack, limit // len(bodies), num_terms)
            for body in bodies
        ),
    )


def _find_rigid_bodies(frame_stack: FrameStack) -> tuple[RigidBody, ...]:
    """Find rigid bodies one after another, removing each from the residual.

    If no path is rigid, the most likely one is removed, because it may occlude others.
    """
    maps = frame_stack.differences()
    bodies = []
    rejected = []
    while len(bodies) < MAX_BODIES and len(rejected) < MAX_REJECTED:
        paths = find_paths(frame_stack, maps)
        if not paths:
            break
        fresh = [path for path in paths if not any(path.is_like(other) for other in rejected)]
        for path in fresh[: MAX_REJECTED - len(rejected)]:
            body = RigidBody(path, estimate_rotation(frame_stack, path))
            if _is_rigid(body.rotation):
                bodies.append(body)
                clear_path_(maps, frame_stack, path)
                break
            rejected.append(path)
        else:
            clear_path_(maps, frame_stack, paths[0])
    return tuple(bodies)


def _is_rigid(rotation: BodyRotation) -> bool:
    least = min(
        MAX_RELATIVE_DISAGREEMENT * rotation.disagreement_without_rotation,
        MAX_RANDOM_FRACTION * rotation.random_disagreement,
    )
    return rotation.random_disagreement >= MIN_TEXTURE and rotation.disagreement < least


def _initial_gaussians(
    body: RigidBody, frame_stack: FrameStack, limit: int, num_terms: int
) -> Gaussians:
    middle = len(frame_stack) // 2
    random = np.random.default_rng(0)
    radius = body.path.radius
    _, depths = frame_stack.project(np.arange(len(frame_stack)), body.path.centers)
    pixels = 4 * np.pi * float(np.median(radius * frame_stack.focal / depths)) ** 2
    count = min(limit, max(int(pixels / PX_PER_GAUSSIAN), 1))
    ways = random.normal(size=(count, 3))
    ways = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    away = radius * random.uniform(INNER, 1.0, size=(count, 1))
    mean_color = body.rotation.colors[body.rotation.counts > 0].mean(0)
    place = cells(ways, FINE)
    colors = np.where(
        body.rotation.counts[place, None] > 0, body.rotation.colors[place], mean_color
    )
    base = torch.from_numpy((colors - 0.5) / SH_C0).float()
    spacing = radius * math.sqrt(4 * math.pi / count)
    means = torch.from_numpy(body.path.centers[middle] + away * ways).float()
    return Gaussians.isotropic(means, math.log(SCALE * spacing), LOGIT, base, num_terms)


def _quats(rotations: np.ndarray) -> np.ndarray:
    """Return quaternions wxyz (T, 4) of ``rotations`` (T, 3, 3) with consistent signs."""
    from scipy.spatial.transform import Rotation

    return align_quat_signs(Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]])


def _fit_spline(basis: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Fit control points (P, D) to ``values`` (T, D) with small second differences."""
    bends = STIFFNESS**0.5 * np.diff(np.eye(basis.shape[1]), n=2, axis=0)
    right = np.concatenate([values, np.zeros((len(bends), values.shape[1]))])
    return np.linalg.lstsq(np.concatenate([basis, bends]), right, rcond=None)[0]
