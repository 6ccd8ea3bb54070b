"""Visual hulls of changed regions per time (Laurentini 1994), from fixed cameras.

Cubes that project onto changes are subdivided until they cover about a pixel. Static objects may
occlude the motion in some cameras: where many cameras see a place, not all need to agree.

Local letters: C cubes, T images of one camera.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image

LONGEST_SIDE, MAX_FULL_IMAGES = 200, 2000
"""Longest side in pixels after downscaling, and number of images up to which it holds.

More images are downscaled further, so that all of them take the same memory.
"""
SMALLEST_CHANGE = 0.05  # smallest change of a channel in [0, 1]
NOISE_MULTIPLE = 5.0
"""Smallest change in standard deviations of the noise, which is estimated from the median."""
# A region must exceed its threshold by this factor somewhere (hysteresis, Canny 1986).
HYSTERESIS = 2.0
MIN_PIXELS = 6
DARKEST_SHADOW = 0.35
SHADOW_TINT = 0.14
"""A shadow leaves at least ``DARKEST_SHADOW`` of the light, and its channels differ by at most
this."""
_MAD_TO_STD = 1.4826
_DARK = 0.03  # added to colours before division


@dataclass(frozen=True)
class FixedCameraClip:
    """Images of one fixed camera, and the changes in them."""

    camera: Cameras  # (V = 1), with the size of the images
    times: tuple[float, ...]  # T, ascending
    images: np.ndarray  # (T, H, W, 3) uint8
    # (T, H, W) bool, pixels that differ from the static background.
    changed: np.ndarray
    counted: np.ndarray  # (T, H, W) bool; False where the image is masked
    median: np.ndarray  # (H, W, 3) uint8, static background


def build_fixed_camera_clip(
    images: Iterable[Image], background: Tensor, total: int = 1
) -> FixedCameraClip:
    """Build the clip of one fixed camera, on the CPU.

    ``total``: number of images of all cameras.
    """
    longest = LONGEST_SIDE * min(1.0, (MAX_FULL_IMAGES / max(total, 1)) ** 0.5)
    shown = []
    counted = []
    times = []
    camera: Cameras | None = None
    for image in images:
        small = image.downscaled(
            math.ceil(max(image.cameras.width, image.cameras.height) / longest)
        )
        rgb = small.composite(background).clamp(0, 1)
        shown.append((255 * rgb).round().to(torch.uint8).cpu().numpy())
        counted.append(
            np.ones(rgb.shape[:2], bool) if small.mask is None else small.mask.cpu().numpy() > 0.5
        )
        times.append(small.time or 0.0)
        camera = small.cameras.to(device="cpu")
    if camera is None:
        raise ValueError("no images")
    stack = np.stack(shown)
    valid = np.stack(counted)
    median = np.median(stack, axis=0).astype(np.uint8)
    return FixedCameraClip(
        camera, tuple(times), stack, detect_changes(stack) & valid, valid, median
    )


def median_image(images: Sequence[Tensor]) -> Tensor:
    """Return the median (H, W, 3) over ``images`` of a fixed camera: the static background."""
    return torch.stack(list(images)).median(0).values


def detect_changes(images: np.ndarray) -> np.ndarray:
    """Return a mask (T, H, W) where ``images`` (T, H, W, 3), uint8, differ from their median.

    The threshold per pixel is the largest of ``SMALLEST_CHANGE`` and a multiple of the noise, of
    all pixels and of its own. Noise is estimated by the median absolute deviation, which is robust
    to motion. Shadows, weak regions and specks are dropped; holes are filled.
    """
    from scipy import ndimage

    values = images.astype(np.float32) / 255
    median = np.median(values, axis=0).astype(np.float32)
    difference_maps = np.abs(values - median).max(-1)
    own = _MAD_TO_STD * np.median(difference_maps, axis=0)
    threshold = np.maximum(
        SMALLEST_CHANGE,
        NOISE_MULTIPLE * np.maximum(own, _MAD_TO_STD * float(np.median(difference_maps))),
    )
    masks = np.zeros(difference_maps.shape, bool)
    for i, (difference, image) in enumerate(zip(difference_maps, values, strict=True)):
        differs = (difference > threshold) & ~detect_shadows(image, median)
        differs = ndimage.binary_closing(np.pad(differs, 2), iterations=1)[2:-2, 2:-2]
        masks[i] = _drop_specks(
            np.asarray(ndimage.binary_fill_holes(differs)), difference / threshold
        )
    return masks


def _drop_specks(differs: np.ndarray, certainty: np.ndarray) -> np.ndarray:
    """Drop small regions, and regions where ``certainty`` is below ``HYSTERESIS`` everywhere."""
    from skimage.measure import label

    labels: np.ndarray = np.asarray(label(differs, connectivity=1))
    sizes = np.bincount(labels.ravel())
    peaks = np.zeros(len(sizes))
    np.maximum.at(peaks, labels.ravel(), certainty.ravel())
    kept = (sizes >= MIN_PIXELS) & (peaks > HYSTERESIS)
    kept[0] = False
    return kept[labels]


def detect_shadows(image: np.ndarray, static: np.ndarray) -> np.ndarray:
    """Return a mask (..., H, W) of shadows: pixels darker than ``static`` by one factor.

    After Horprasert et al. 1999.
    """
    left = (image + _DARK) / (static + _DARK)
    tint = left.max(-1) - left.min(-1)
    return (left.max(-1) < 1) & (left.min(-1) > DARKEST_SHADOW) & (tint < SHADOW_TINT)


FIRST_CUBES = 16  # cubes along the longest side of the box at first
MAX_CUBES = 300_000  # subdivision stops at this number
LARGEST_PX = 2.0  # subdivision stops at this side length in pixels
MAX_LEVELS = 8
MISSING_FRACTION = 0.25
"""Fraction of the cameras that see a place in which the object may be occluded."""
ENOUGH_VIEWS = 3  # cameras that must see a change, or all there are
MIN_CUBES = 12
SOLID_FRACTION = 0.3
"""Smallest part of a blob that is kept of the cubes that most cameras agree on."""
NEAR = 1e-3


@dataclass(frozen=True)
class Blob:
    """A connected component of the visual hull at one time."""

    center: np.ndarray  # (3,) mean of the cubes
    radius: float  # of a ball of the same volume, world units
    cubes: np.ndarray  # (C, 3) centres
    side: float
    color: np.ndarray  # (3,) mean colour in the images, 0 to 1


@dataclass(frozen=True)
class ChangedRegion:
    """Changed pixels of one camera at one time."""

    projection: np.ndarray  # (3, 4) projection matrix
    image: np.ndarray  # (H, W, 3) uint8
    # (H, W) bool, see ``FixedCameraClip``.
    changed: np.ndarray
    counted: np.ndarray
    # Integral images (H + 1, W + 1) of ``changed`` and of masked pixels.
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
        """Project ``points`` (C, 3) to pixels (C, 2) and depths (C,); pixels are 0 behind the
        camera."""
        u, v, depth = self.projection[:, :3] @ points.T + self.projection[:, 3:]
        safe = np.where(depth > NEAR, depth, np.inf)
        return np.stack([u / safe, v / safe], -1), depth

    def sample(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return masks (C,): whether ``points`` are in the image, and whether it changes there."""
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

    def classify_cubes(
        self, centers: np.ndarray, side: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Classify cubes; return masks (C,): partly in the image, wholly in it, and touching a
        change."""
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


def silhouettes_at(clips: Sequence[FixedCameraClip], time: float) -> list[ChangedRegion]:
    """Return the changed regions of the cameras that took an image at ``time``."""
    regions: list[ChangedRegion] = []
    for one in clips:
        if time not in one.times:
            continue
        i = one.times.index(time)
        pose = one.camera.cam_from_world[0].double().cpu().numpy()[:3]
        projection = one.camera.intrinsics[0].double().cpu().numpy() @ pose
        sums, masked = (
            np.pad(x.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
            for x in (one.changed[i], ~one.counted[i])
        )
        regions.append(
            ChangedRegion(projection, one.images[i], one.changed[i], one.counted[i], sums, masked)
        )
    return regions


def extract_blobs(views: Sequence[ChangedRegion], low: np.ndarray, high: np.ndarray) -> list[Blob]:
    """Carve the visual hull of ``views`` in the box ``low`` to ``high``; return its components."""
    if len(views) < 2:
        return []
    side = float((high - low).max()) / FIRST_CUBES
    counts = np.maximum(np.ceil((high - low) / side), 1).astype(int)
    cubes = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), -1).reshape(-1, 3)
    for level in range(MAX_LEVELS):
        centers = low + (cubes + 0.5) * side
        cubes = cubes[_may_contain(views, centers, side)]
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
    agreeing, kept = _agreement(views, centers)
    cubes = cubes[kept]
    centers = centers[kept]
    agreeing = agreeing[kept]
    labels = _components(cubes)
    order = np.argsort(labels, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1) if len(order) else []
    parts = [_most_agreed(group, agreeing) for group in groups if len(group) >= MIN_CUBES]
    return [_blob(views, centers[part], side) for part in parts]


def _may_contain(views: Sequence[ChangedRegion], centers: np.ndarray, side: float) -> np.ndarray:
    """Return a mask (C,) of the cubes that may contain a point accepted by ``_agreement``."""
    seeing, whole, agreeing = np.zeros((3, len(centers)), int)
    for view in views:
        partly, wholly, changing = view.classify_cubes(centers, side)
        seeing += partly
        whole += wholly & ~changing
        agreeing += changing
    return (agreeing >= min(ENOUGH_VIEWS, len(views))) & (
        whole <= np.floor(MISSING_FRACTION * seeing)
    )


def _agreement(views: Sequence[ChangedRegion], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of cameras (C,) that see a change at ``points``, and whether that
    suffices."""
    seeing, agreeing = np.zeros((2, len(points)), int)
    for view in views:
        inside, changing = view.sample(points)
        seeing += inside
        agreeing += changing
    enough = (agreeing >= min(ENOUGH_VIEWS, len(views))) & (
        seeing - agreeing <= np.floor(MISSING_FRACTION * seeing)
    )
    return agreeing, enough


def _largest_px(views: Sequence[ChangedRegion], centers: np.ndarray, side: float) -> float:
    """Return the size of ``side`` in pixels at the median of ``centers``, median over cameras."""
    middle = np.median(centers, axis=0)
    depths = [max(float(view.pixels(middle[None])[1][0]), NEAR) for view in views]
    return float(
        np.median([view.focal * side / depth for view, depth in zip(views, depths, strict=True)])
    )


def _components(cubes: np.ndarray) -> np.ndarray:
    """Return labels (C,) of face-connected components of the integer ``cubes`` (C, 3)."""
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


def _most_agreed(group: np.ndarray, agreeing: np.ndarray) -> np.ndarray:
    """Return the part of ``group`` that most cameras agree on.

    Tolerance for occlusion makes hulls too large.
    """
    own = agreeing[group]
    for least in range(int(own.max()), 0, -1):
        part: np.ndarray = group[own >= least]
        if len(part) >= max(SOLID_FRACTION * len(group), MIN_CUBES):
            return part
    return group


def _blob(views: Sequence[ChangedRegion], points: np.ndarray, side: float) -> Blob:
    colors: list[np.ndarray] = []
    for view in views:
        _, changing = view.sample(points)
        if changing.any():
            x, y = np.floor(view.pixels(points[changing])[0]).astype(int).T
            colors.append(view.image[y, x].mean(0) / 255)
    color = np.mean(colors, axis=0) if colors else np.full(3, 0.5)
    radius = float((len(points) * side**3 * 3 / (4 * np.pi)) ** (1 / 3))
    return Blob(points.mean(0), radius, points, side, color)


MAX_GAP = 3  # times in a row at which a track may be lost
MIN_TIMES = 4  # times at which an object must be found
# Search radius in object radii while the velocity is unknown.
FIRST_REACH = 6.0
REACH, SPEED_REACH = 3.0, 1.5
"""Search radius in object radii, and in fractions of the last displacement."""
COLOR_REACH, SIZE_REACH = 0.35, 1.2
"""Differences of colour and log radius from which a blob belongs to another object."""
MIN_STEPS = 2
MIN_CORRELATION = -0.2
"""Least number of steps of a travelling object, and least correlation of successive steps.

Bouncing objects turn back, too, but less often than noise.
"""


@dataclass(frozen=True)
class Track:
    """An object tracked over time."""

    times: tuple[float, ...]
    blobs: tuple[Blob, ...]

    @property
    def centers(self) -> np.ndarray:
        return np.stack([blob.center for blob in self.blobs])

    @property
    def radius(self) -> float:
        return float(np.median([blob.radius for blob in self.blobs]))

    @property
    def is_travelling(self) -> bool:
        """True if the object travels; rotation or deformation in place is not a track to start
        from.

        Between positions at least a radius apart, successive steps must not mostly turn back.
        """
        centers = self.centers
        places = [centers[0]]
        for center in centers[1:]:
            if np.linalg.norm(center - places[-1]) >= self.radius:
                places.append(center)
        steps: np.ndarray = np.diff(np.stack(places), axis=0)
        if len(steps) < MIN_STEPS:
            return False
        return float((steps[1:] * steps[:-1]).sum()) > MIN_CORRELATION * float((steps**2).sum())

    def predict(self, time: float) -> np.ndarray:
        last = self.blobs[-1].center
        if len(self.blobs) < 2:
            return last
        pace = (last - self.blobs[-2].center) / (self.times[-1] - self.times[-2])
        return last + (time - self.times[-1]) * pace

    def append(self, time: float, blob: Blob) -> Track:
        return Track((*self.times, time), (*self.blobs, blob))


def link_tracks(times: Sequence[float], blobs: Sequence[Sequence[Blob]]) -> list[Track]:
    """Link the ``blobs`` of all ``times`` (ascending) into tracks, longest first.

    Blobs are assigned to tracks by the least total cost (Kuhn 1955), within a gate around the
    position at constant velocity. A track may miss a few times in a row; short tracks are dropped.
    """
    from scipy.optimize import linear_sum_assignment

    done: list[Track] = []
    open_: list[Track] = []
    for i, (time, current) in enumerate(zip(times, blobs, strict=True)):
        oldest = times[max(i - MAX_GAP - 1, 0)]
        done += [track for track in open_ if track.times[-1] < oldest]
        open_ = [track for track in open_ if track.times[-1] >= oldest]
        cost = np.full((len(open_), len(current)), np.inf)
        for row, track in enumerate(open_):
            cost[row] = [_cost(track, time, blob) for blob in current]
        rows, columns = linear_sum_assignment(np.minimum(cost, 1e3))
        taken = {int(c): int(r) for r, c in zip(rows, columns, strict=True) if cost[r, c] < np.inf}
        fresh = [Track((time,), (blob,)) for j, blob in enumerate(current) if j not in taken]
        for column, row in taken.items():
            open_[row] = open_[row].append(time, current[column])
        open_ += fresh
    kept = [track for track in done + open_ if len(track.times) >= MIN_TIMES]
    return sorted(kept, key=lambda track: -len(track.times))


def _cost(track: Track, time: float, blob: Blob) -> float:
    """Return the cost of appending ``blob`` to ``track``; infinite if impossible."""
    last = track.blobs[-1]
    reach = FIRST_REACH * last.radius
    if len(track.blobs) > 1:
        step = np.linalg.norm(track.predict(time) - last.center)
        reach = REACH * max(last.radius, track.radius) + SPEED_REACH * float(step)
    terms = (
        float(np.linalg.norm(blob.center - track.predict(time))) / reach,
        float(np.abs(blob.color - last.color).max()) / COLOR_REACH,
        abs(float(np.log(blob.radius / track.radius))) / SIZE_REACH,
    )
    return sum(terms) if max(terms) < 1 else np.inf
