"""Visual hulls of what changes, one set per time (Laurentini 1994), from cameras that stand still.

Cubes that project onto changes are divided again and again until they are about a pixel large.
Things may be hidden behind still ones in some cameras: where many see a place, not all need agree.

Local letters: C cubes, T images of one camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dyngs.deform.fixed_cameras.changes import Footage

FIRST_CUBES = 16  # Cubes along the longest side of the box that carving begins with
MAX_CUBES = 300_000  # Carving stops to divide cubes at this number
LARGEST_PX = 2.0  # Pixels that a side covers, in most cameras, when cubes are no longer divided
MAX_LEVELS = 8
MISSING_FRACTION = 0.25
"""Fraction of the cameras that see a place which may not see the thing there, because something
still hides it."""
ENOUGH_VIEWS = 3  # Cameras that must see a change at a place, or all there are
FEWEST_CUBES = 12
SOLID_FRACTION = 0.3
"""Of a blob, the cubes that most cameras agree on are kept, as long as they are this fraction of
all."""
NEAR = 1e-3


@dataclass(frozen=True)
class Blob:
    """A connected part of a visual hull at one time."""

    center: np.ndarray  # (3,) mean of the cubes
    radius: float  # of a ball of that volume, world units
    cubes: np.ndarray  # (C, 3) centres
    side: float
    color: np.ndarray  # (3,) mean colour in the images, 0 to 1


@dataclass(frozen=True)
class ChangedRegion:
    """Change that one camera sees at one time."""

    projection: np.ndarray  # (3, 4) matrix from the world to homogeneous pixels
    image: np.ndarray  # (H, W, 3) uint8
    # changed, counted: (H, W) bool, see ``Footage``
    changed: np.ndarray
    counted: np.ndarray
    # sums, masked: (H + 1, W + 1) summed areas of ``changed``, and of what is not counted
    sums: np.ndarray
    masked: np.ndarray

    @property
    def center(self) -> np.ndarray:
        return -np.linalg.solve(self.projection[:, :3], self.projection[:, 3])

    @property
    def focal(self) -> float:
        return float(
            np.linalg.norm(self.projection[0, :3] - self.projection[2, :3] * self._principal)
        )

    @property
    def _principal(self) -> float:
        return float(self.projection[0, :3] @ self.projection[2, :3])

    def pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (C, 2) pixel coordinates and (C,) depths of ``points`` (C, 3); those behind the
        camera have none."""
        u, v, depth = self.projection[:, :3] @ points.T + self.projection[:, 3:]
        safe = np.where(depth > NEAR, depth, np.inf)
        return np.stack([u / safe, v / safe], -1), depth

    def seen(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (C,) bool, whether ``points`` lie in the image, and whether it changes there."""
        place, depth = self.pixels(points)
        height, width = self.changed.shape
        x, y = (
            np.clip(np.floor(place[:, i]), -1, limit).astype(int)
            for i, limit in enumerate((width, height))
        )
        inside = (depth > NEAR) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        x = np.where(inside, x, 0)
        y = np.where(inside, y, 0)
        inside &= self.counted[y, x]
        return inside, inside & self.changed[y, x]

    def touched(
        self, centers: np.ndarray, side: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (C,) bool of cubes: part of it may be in the image, all of it is, and part of it
        may change."""
        place, depth = self.pixels(centers)
        reach = 0.5 * np.sqrt(3.0) * side
        spread = self.focal * reach / np.maximum(depth - reach, NEAR) + 1.0
        height, width = self.changed.shape
        low = np.floor(place - spread[:, None])
        high = np.ceil(place + spread[:, None])
        ahead = depth > -reach
        limits = np.array([width, height])
        partly = ahead & (high > 0).all(1) & (low < limits).all(1)
        wholly = partly & (low >= 0).all(1) & (high <= limits).all(1) & (depth > reach)
        x0, y0 = np.clip(low, 0, limits).astype(int).T
        x1, y1 = np.clip(high, 0, limits).astype(int).T
        changing, masked = (
            s[y1, x1] - s[y0, x1] - s[y1, x0] + s[y0, x0] for s in (self.sums, self.masked)
        )
        around = ahead & (depth <= reach)
        return partly | around, wholly & (masked == 0), (partly & (changing > 0)) | around


def silhouettes_at(footage: Sequence[Footage], time: float) -> list[ChangedRegion]:
    """Return what the cameras that took an image at ``time`` saw to change then."""
    found: list[ChangedRegion] = []
    for one in footage:
        if time not in one.times:
            continue
        i = one.times.index(time)
        pose = one.camera.cam_from_world[0].double().cpu().numpy()[:3]
        projection = one.camera.intrinsics[0].double().cpu().numpy() @ pose
        sums, masked = (
            np.pad(x.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
            for x in (one.changed[i], ~one.counted[i])
        )
        found.append(
            ChangedRegion(projection, one.images[i], one.changed[i], one.counted[i], sums, masked)
        )
    return found


def blobs_in(views: Sequence[ChangedRegion], low: np.ndarray, high: np.ndarray) -> list[Blob]:
    """Return the connected parts of the visual hull of what ``views`` see to change, in the box
    ``low`` to ``high``."""
    if len(views) < 2:
        return []
    side = float((high - low).max()) / FIRST_CUBES
    counts = np.maximum(np.ceil((high - low) / side), 1).astype(int)
    cubes = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), -1).reshape(-1, 3)
    for level in range(MAX_LEVELS):
        centers = low + (cubes + 0.5) * side
        cubes = cubes[_may_hold(views, centers, side)]
        if not len(cubes):
            return []
        if (
            level == MAX_LEVELS - 1
            or 8 * len(cubes) > MAX_CUBES
            or _largest_px(views, centers, side) <= LARGEST_PX
        ):
            break
        halves = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
        cubes = (2 * cubes[:, None] + halves).reshape(-1, 3)
        side = side / 2
    centers = low + (cubes + 0.5) * side
    agreeing, kept = _agreed(views, centers)
    cubes = cubes[kept]
    centers = centers[kept]
    agreeing = agreeing[kept]
    labels = _components(cubes)
    order = np.argsort(labels, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1) if len(order) else []
    parts = [_solid(group, agreeing) for group in groups if len(group) >= FEWEST_CUBES]
    return [_blob(views, centers[part], side) for part in parts]


def _may_hold(views: Sequence[ChangedRegion], centers: np.ndarray, side: float) -> np.ndarray:
    """Return (C,) bool: whether any part of a cube may satisfy ``_agreed``."""
    seeing, whole, agreeing = np.zeros((3, len(centers)), int)
    for view in views:
        partly, wholly, changes = view.touched(centers, side)
        seeing += partly
        whole += wholly & ~changes
        agreeing += changes
    return (agreeing >= min(ENOUGH_VIEWS, len(views))) & (
        whole <= np.floor(MISSING_FRACTION * seeing)
    )


def _agreed(views: Sequence[ChangedRegion], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (C,) numbers of cameras that see a change at ``points``, and whether they are
    enough."""
    seeing, agreeing = np.zeros((2, len(points)), int)
    for view in views:
        inside, changes = view.seen(points)
        seeing += inside
        agreeing += changes
    enough = (agreeing >= min(ENOUGH_VIEWS, len(views))) & (
        seeing - agreeing <= np.floor(MISSING_FRACTION * seeing)
    )
    return agreeing, enough


def _largest_px(views: Sequence[ChangedRegion], centers: np.ndarray, side: float) -> float:
    """Return the pixels that ``side`` covers in the middle of ``centers``: the median over the
    cameras."""
    middle = np.median(centers, axis=0)
    depths = [max(float(view.pixels(middle[None])[1][0]), NEAR) for view in views]
    return float(
        np.median([view.focal * side / depth for view, depth in zip(views, depths, strict=True)])
    )


def _components(cubes: np.ndarray) -> np.ndarray:
    """Return (C,) labels of ``cubes`` (C, 3), integers: those that share a face are alike."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if not len(cubes):
        return np.zeros(0, int)
    shape = cubes.max(0) + 2
    flat: np.ndarray = np.asarray(np.ravel_multi_index(tuple(cubes.T), tuple(shape)))
    order = np.argsort(flat)
    ordered: np.ndarray = flat[order]
    pairs: list[np.ndarray] = []
    for axis in range(3):
        beside = cubes.copy()
        beside[:, axis] += 1
        wanted = np.ravel_multi_index(tuple(beside.T), tuple(shape))
        at = np.asarray(np.searchsorted(ordered, wanted)).clip(max=len(flat) - 1)
        hit = ordered[at] == wanted
        pairs.append(np.stack([np.flatnonzero(hit), order[at[hit]]]))
    first, second = np.concatenate(pairs, axis=1)
    graph = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(len(cubes), len(cubes)))
    _, labels = connected_components(graph, directed=False)
    return np.asarray(labels)


def _solid(group: np.ndarray, agreeing: np.ndarray) -> np.ndarray:
    """Return the part of ``group`` that most cameras agree on: tolerance for hidden views makes
    hulls too large."""
    own = agreeing[group]
    for least in range(int(own.max()), 0, -1):
        part: np.ndarray = group[own >= least]
        if len(part) >= max(SOLID_FRACTION * len(group), FEWEST_CUBES):
            return part
    return group


def _blob(views: Sequence[ChangedRegion], points: np.ndarray, side: float) -> Blob:
    colors: list[np.ndarray] = []
    for view in views:
        _, changes = view.seen(points)
        if changes.any():
            x, y = np.floor(view.pixels(points[changes])[0]).astype(int).T
            colors.append(view.image[y, x].mean(0) / 255)
    color = np.mean(colors, axis=0) if colors else np.full(3, 0.5)
    radius = float((len(points) * side**3 * 3 / (4 * np.pi)) ** (1 / 3))
    return Blob(points.mean(0), radius, points, side, color)
