"""Visual hulls of what changes, one set per time (Laurentini 1994), from cameras that stand still.

Cubes that project onto changes are divided again and again until they are about a pixel large.
Things may be hidden behind still ones in some cameras: where many see a place, not all need agree.

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

LONGEST_SIDE, IMAGES = 200, 2000
"""Pixels; larger images are shrunk: silhouettes need no more, and noise averages out. Of more
images than that, each is smaller, so that all of them together take as much memory."""
SMALLEST_CHANGE = 0.05  # Least difference in a channel, of 1, that counts as a change
NOISE_MULTIPLE = 5.0
"""Differences below so many standard deviations of the noise, as estimated from the median, are no
change."""
# A change must reach this multiple of its threshold somewhere, as in hysteresis thresholding (Canny
# 1986)
SURE = 2.0
FEWEST_PIXELS = 6
DARKEST_SHADOW = 0.35
SHADOW_TINT = 0.14
"""A shadow leaves at least that fraction of the light and changes no channel by more than this
share beyond the others."""
_MAD_TO_STD = 1.4826
_DARK = 0.03  # Added to colours before they are divided


@dataclass(frozen=True)
class FixedCameraClip:
    """Images of one camera that stands still, and what changes in them."""

    camera: Cameras  # (V = 1) of the images' size
    times: tuple[float, ...]  # T, ascending
    images: np.ndarray  # (T, H, W, 3) uint8
    # (T, H, W) bool: shows something that is elsewhere, or not there, at most other times
    changed: np.ndarray
    counted: np.ndarray  # (T, H, W) bool; False where the image is masked out
    median: np.ndarray  # (H, W, 3) uint8, what is still


def build_fixed_camera_clip(
    images: Iterable[Image], background: Tensor, total: int = 1
) -> FixedCameraClip:
    """Return the frames of one camera that stands still, on the CPU."""
    longest = LONGEST_SIDE * min(1.0, (IMAGES / max(total, 1)) ** 0.5)
    shown = []
    counted = []
    times = []
    camera: Cameras | None = None
    for image in images:
        small = image.shrunk(math.ceil(max(image.cameras.width, image.cameras.height) / longest))
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
    return FixedCameraClip(camera, tuple(times), stack, changes(stack) & valid, valid, median)


def median_image(images: Sequence[Tensor]) -> Tensor:
    """Return the median (H, W, 3) over ``images`` of a camera in place: what is still, as it is."""
    return torch.stack(list(images)).median(0).values


def changes(images: np.ndarray) -> np.ndarray:
    """Return (T, H, W) bool: where ``images`` (T, H, W, 3), uint8, differ from their median,
    shadows left out.

    The threshold of a pixel is the largest of ``SMALLEST_CHANGE`` and a multiple of the noise, that
    of all pixels and its own; both are estimated by the median absolute deviation, which what moves
    does not affect. Of what lies above, connected parts without a pixel far above, and specks, are
    dropped; holes, as shadows leave them, are filled.
    """
    from scipy import ndimage

    values = images.astype(np.float32) / 255
    median = np.median(values, axis=0).astype(np.float32)
    apart = np.abs(values - median).max(-1)
    own = _MAD_TO_STD * np.median(apart, axis=0)
    threshold = np.maximum(
        SMALLEST_CHANGE, NOISE_MULTIPLE * np.maximum(own, _MAD_TO_STD * float(np.median(apart)))
    )
    found = np.zeros(apart.shape, bool)
    for i, (difference, image) in enumerate(zip(apart, values, strict=True)):
        differs = (difference > threshold) & ~detect_shadows(image, median)
        differs = ndimage.binary_closing(np.pad(differs, 2), iterations=1)[2:-2, 2:-2]
        found[i] = _without_specks(
            np.asarray(ndimage.binary_fill_holes(differs)), difference / threshold
        )
    return found


def _without_specks(differs: np.ndarray, certainty: np.ndarray) -> np.ndarray:
    """Return ``differs`` (H, W) without small parts, and those in which ``certainty`` is below
    ``SURE`` all over."""
    from skimage.measure import label

    labels: np.ndarray = np.asarray(label(differs, connectivity=1))
    sizes = np.bincount(labels.ravel())
    peaks = np.zeros(len(sizes))
    np.maximum.at(peaks, labels.ravel(), certainty.ravel())
    kept = (sizes >= FEWEST_PIXELS) & (peaks > SURE)
    kept[0] = False
    return kept[labels]


def detect_shadows(image: np.ndarray, static: np.ndarray) -> np.ndarray:
    """Return (..., H, W) bool: as ``still`` but darker, all channels alike (after Horprasert et al.
    1999)."""
    left = (image + _DARK) / (static + _DARK)
    tint = left.max(-1) - left.min(-1)
    return (left.max(-1) < 1) & (left.min(-1) > DARKEST_SHADOW) & (tint < SHADOW_TINT)


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
    # changed, counted: (H, W) bool, see ``FixedCameraClip``
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


def silhouettes_at(clips: Sequence[FixedCameraClip], time: float) -> list[ChangedRegion]:
    """Return what the cameras that took an image at ``time`` saw to change then."""
    found: list[ChangedRegion] = []
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
        found.append(
            ChangedRegion(projection, one.images[i], one.changed[i], one.counted[i], sums, masked)
        )
    return found


def extract_blobs(views: Sequence[ChangedRegion], low: np.ndarray, high: np.ndarray) -> list[Blob]:
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


MAX_GAP = 3  # Times in a row at which a thing may be lost
FEWEST_TIMES = 4  # Times at which a thing must be found
# Radii within which a thing whose velocity is not known is looked for at the next time
FIRST_REACH = 6.0
REACH, SPEED_REACH = 3.0, 1.5
"""Radii, and fractions of the last displacement, by which a thing may be away from where its
velocity takes it."""
COLOR_REACH, SIZE_REACH = 0.35, 1.2
"""Differences of colour, and of the logarithm of the radius, at which a blob is another thing."""
FEWEST_STEPS = 2
SAME_WAY = -0.2
"""Steps of at least a radius that a thing which travels makes, and the least correlation of each
with the next: what hops turns back, too, but less often than noise does."""


@dataclass(frozen=True)
class Track:
    """A thing followed over time."""

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
        """Whether it goes on and on: what turns or bends in place is no track to start from.

        Of places a radius apart or more, in the order of time, successive steps must not mostly
        turn back.
        """
        centers = self.centers
        places = [centers[0]]
        for center in centers[1:]:
            if np.linalg.norm(center - places[-1]) >= self.radius:
                places.append(center)
        steps: np.ndarray = np.diff(np.stack(places), axis=0)
        if len(steps) < FEWEST_STEPS:
            return False
        return float((steps[1:] * steps[:-1]).sum()) > SAME_WAY * float((steps**2).sum())

    def predict(self, time: float) -> np.ndarray:
        last = self.blobs[-1].center
        if len(self.blobs) < 2:
            return last
        pace = (last - self.blobs[-2].center) / (self.times[-1] - self.times[-2])
        return last + (time - self.times[-1]) * pace

    def append(self, time: float, blob: Blob) -> Track:
        return Track((*self.times, time), (*self.blobs, blob))


def link_tracks(times: Sequence[float], blobs: Sequence[Sequence[Blob]]) -> list[Track]:
    """Return the tracks among the ``blobs`` of each of ``times`` (ascending), longest first.

    Blobs are assigned to the tracks so far by the least total cost (Kuhn 1955), each within a gate
    around where constant velocity takes a track. A track may miss some times in a row; those found
    too rarely are left out.
    """
    from scipy.optimize import linear_sum_assignment

    done: list[Track] = []
    open_: list[Track] = []
    for i, (time, found) in enumerate(zip(times, blobs, strict=True)):
        oldest = times[max(i - MAX_GAP - 1, 0)]
        done += [track for track in open_ if track.times[-1] < oldest]
        open_ = [track for track in open_ if track.times[-1] >= oldest]
        cost = np.full((len(open_), len(found)), np.inf)
        for row, track in enumerate(open_):
            cost[row] = [_cost(track, time, blob) for blob in found]
        rows, columns = linear_sum_assignment(np.minimum(cost, 1e3))
        taken = {int(c): int(r) for r, c in zip(rows, columns, strict=True) if cost[r, c] < np.inf}
        fresh = [Track((time,), (blob,)) for j, blob in enumerate(found) if j not in taken]
        for column, row in taken.items():
            open_[row] = open_[row].append(time, found[column])
        open_ += fresh
    kept = [track for track in done + open_ if len(track.times) >= FEWEST_TIMES]
    return sorted(kept, key=lambda track: -len(track.times))


def _cost(track: Track, time: float, blob: Blob) -> float:
    """Return the cost of taking ``blob`` for the next of ``track``; infinite where it cannot be."""
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
