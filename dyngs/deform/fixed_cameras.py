"""Where motion begins before cameras that stand still: at what they see to change.

Changes are carved into visual hulls (Laurentini 1994): cubes that project onto changes are divided
again and again until they are about two pixels large, and linked over time. Things may be hidden behind still ones in
some cameras: where many see a place, not all need agree.

Local letters: C cubes, T images of one camera, N still Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0
from dyngs.data.loader import Image
from dyngs.deform.random_gaussians import box_of
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.ops.quaternions import rotate

SMALLEST_CHANGE = 0.05  # Least difference in a channel, of 1, that counts as a change
LOGIT = 1.4  # Opacity 0.8 of new Gaussians: where a hull is, something is
NEAR = 1e-3
LONGEST_SIDE = 200
"""Pixels; larger images are shrunk: silhouettes need no more, and noise averages out."""


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


def fixed_camera_clip(
    images: Iterable[Image], background: Tensor, total: int = 1
) -> FixedCameraClip:
    """Return the frames of one camera that stands still, on the CPU.

    Args:
        total: images of all cameras; of more than 2000 each is smaller, for memory.
    """
    longest = LONGEST_SIDE * min(1.0, (2000 / total) ** 0.5)
    small = [x.shrunk(math.ceil(max(x.cameras.width, x.cameras.height) / longest)) for x in images]
    stack = np.stack(
        [
            (255 * x.composite(background).clamp(0, 1)).round().to(torch.uint8).cpu().numpy()
            for x in small
        ]
    )
    counted = np.stack(
        [
            np.ones(rgb.shape[:2], bool) if x.mask is None else x.mask.cpu().numpy() > 0.5
            for x, rgb in zip(small, stack, strict=True)
        ]
    )
    camera = small[-1].cameras.to(device="cpu")
    times = tuple(x.time or 0.0 for x in small)
    median = np.median(stack, axis=0).astype(np.uint8)
    return FixedCameraClip(camera, times, stack, changes(stack) & counted, counted, median)


def median_image(images: Sequence[Tensor]) -> Tensor:
    """Return the median (H, W, 3) over ``images`` of a camera in place: what is still, as it is."""
    return torch.stack(list(images)).median(0).values


def changes(images: np.ndarray) -> np.ndarray:
    """Return (T, H, W) bool: where ``images`` (T, H, W, 3), uint8, differ from their median,
    shadows left out.

    The threshold of a pixel is the largest of ``SMALLEST_CHANGE`` and five standard deviations of
    the noise, that of all pixels and its own; both are estimated by the median absolute deviation,
    which what moves does not affect. Of what lies above, connected parts that nowhere reach twice
    the threshold (as in hysteresis thresholding, Canny 1986), and specks, are dropped; holes, as
    shadows leave them, are filled.
    """
    from scipy import ndimage

    values = images.astype(np.float32) / 255
    median = np.median(values, axis=0).astype(np.float32)
    apart = np.abs(values - median).max(-1)
    noise = 1.4826 * np.maximum(np.median(apart, axis=0), float(np.median(apart)))
    threshold = np.maximum(SMALLEST_CHANGE, 5 * noise)
    found = np.zeros(apart.shape, bool)
    for i, (difference, image) in enumerate(zip(apart, values, strict=True)):
        differs = (difference > threshold) & ~shadows(image, median)
        differs = ndimage.binary_closing(np.pad(differs, 2), iterations=1)[2:-2, 2:-2]
        labels, count = ndimage.label(ndimage.binary_fill_holes(differs))
        parts = np.arange(count + 1)
        peaks = ndimage.maximum(difference / threshold, labels, parts)
        kept = (np.bincount(labels.ravel()) >= 6) & (peaks > 2) & (parts > 0)
        found[i] = kept[labels]
    return found


def shadows(image: np.ndarray, still: np.ndarray) -> np.ndarray:
    """Return (..., H, W) bool: as ``still`` but darker, all channels alike (after Horprasert et al.
    1999): a shadow leaves a third of the light, and no channel changes much beyond the others."""
    left = (image + 0.03) / (still + 0.03)
    tint = left.max(-1) - left.min(-1)
    return (left.max(-1) < 1) & (left.min(-1) > 0.35) & (tint < 0.14)


class ChangedView:
    """Change that one camera sees at one time."""

    def __init__(self, clip: FixedCameraClip, index: int) -> None:
        pose = clip.camera.cam_from_world[0].double().numpy()[:3]
        intrinsics = clip.camera.intrinsics[0].double().numpy()
        self.projection = intrinsics @ pose
        self.center = -pose[:, :3].T @ pose[:, 3]
        self.focal = float(intrinsics[0, 0])
        self.image = clip.images[index]
        self.changed = clip.changed[index]
        self.counted = clip.counted[index]
        # summed areas
        self._changed, self._masked = (
            np.pad(x.cumsum(0).cumsum(1), ((1, 0), (1, 0))) for x in (self.changed, ~self.counted)
        )

    def pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (C, 2) pixel coordinates and (C,) depths of ``points`` (C, 3); those behind the
        camera have none."""
        u, v, depth = self.projection[:, :3] @ points.T + self.projection[:, 3:]
        safe = np.where(depth > NEAR, depth, np.inf)
        return np.stack([u / safe, v / safe], -1), depth

    def seen(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (C,) bool, whether ``points`` lie in the image, and whether it changes there."""
        place, depth = self.pixels(points)
        x, y = np.floor(place).astype(int).T
        height, width = self.changed.shape
        inside = (depth > NEAR) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        x = np.where(inside, x, 0)
        y = np.where(inside, y, 0)
        inside &= self.counted[y, x]
        return inside, inside & self.changed[y, x]

    def cubes(self, centers: np.ndarray, side: float) -> np.ndarray:
        """Return (3, C) bool of cubes: part of it may be in the image, all of it is and does not
        change, and part of it may change."""
        place, depth = self.pixels(centers)
        reach = 0.5 * np.sqrt(3.0) * side
        spread = self.focal * reach / np.maximum(depth - reach, NEAR) + 1.0
        low = np.floor(place - spread[:, None])
        high = np.ceil(place + spread[:, None])
        size = self.changed.shape[::-1]
        x0, y0 = np.clip(low, 0, size).astype(int).T
        x1, y1 = np.clip(high, 0, size).astype(int).T
        changing, masked = (
            x[y1, x1] - x[y0, x1] - x[y1, x0] + x[y0, x0] for x in (self._changed, self._masked)
        )
        around = np.abs(depth) <= reach
        partly = (depth > reach) & (high > 0).all(1) & (low < size).all(1)
        still = partly & (low >= 0).all(1) & (high <= size).all(1) & (masked + changing == 0)
        return np.stack([partly | around, still, partly & (changing > 0) | around])

    def colours(self, points: np.ndarray) -> np.ndarray:
        """Return (C, 3) colours, 0 to 1, of ``points`` in the image."""
        x, y = np.floor(self.pixels(points)[0]).astype(int).T
        return self.image[y, x] / 255


def views_at(clips: Sequence[FixedCameraClip], time: float) -> list[ChangedView]:
    """Return what the cameras that took an image at ``time`` saw to change then."""
    return [ChangedView(x, x.times.index(time)) for x in clips if time in x.times]


@dataclass(frozen=True)
class Hull:
    """A connected part of a visual hull at one time."""

    cubes: np.ndarray  # (C, 3) centres
    side: float

    @property
    def center(self) -> np.ndarray:
        return self.cubes.mean(0)

    @property
    def radius(self) -> float:
        """Radius of a ball of that volume, world units."""
        return float((len(self.cubes) * self.side**3 * 3 / (4 * np.pi)) ** (1 / 3))


def hulls_in(views: Sequence[ChangedView], low: np.ndarray, high: np.ndarray) -> list[Hull]:
    """Return the connected parts of the visual hull of what ``views`` see to change, in the box
    ``low`` to ``high``.

    A change must be seen by three cameras, or all there are. A quarter of those that see a place
    may see no change there, because something still hides it.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    if len(views) < 2:
        return []
    needed = min(3, len(views))
    side = float((high - low).max()) / 16
    cubes = np.argwhere(np.ones(np.maximum(np.ceil((high - low) / side), 1).astype(int), bool))
    halves = np.argwhere(np.ones((2, 2, 2), bool))
    for level in range(8):
        centers = low + (cubes + 0.5) * side
        seeing, still, agreeing = np.sum([x.cubes(centers, side) for x in views], 0)
        cubes = cubes[(agreeing >= needed) & (still <= np.floor(0.25 * seeing))]
        if not len(cubes):
            return []
        middle = np.median(centers, axis=0)[None]
        pixels = [x.focal * side / max(float(x.pixels(middle)[1][0]), NEAR) for x in views]
        if level == 7 or 8 * len(cubes) > 300_000 or np.median(pixels) <= 2:
            break
        cubes = (2 * cubes[:, None] + halves).reshape(-1, 3)
        side = side / 2
    inside, agreeing = np.sum([x.seen(low + (cubes + 0.5) * side) for x in views], 0)
    kept = (agreeing >= needed) & (inside - agreeing <= np.floor(0.25 * inside))
    cubes = cubes[kept]
    agreeing = agreeing[kept]
    beside = KDTree(cubes).query_pairs(1, p=1, output_type="ndarray") if len(cubes) else cubes
    graph = coo_matrix((np.ones(len(beside), bool), beside.T[:2]), shape=(len(cubes),) * 2)
    labels = connected_components(graph, directed=False)[1]
    parts = [labels == label for label in np.flatnonzero(np.bincount(labels) >= 12)]
    return [Hull(low + (cubes[_solid(x, agreeing)] + 0.5) * side, side) for x in parts]


def _solid(part: np.ndarray, agreeing: np.ndarray) -> np.ndarray:
    """Return the cubes of a ``part`` that most cameras agree on, three tenths of it at least:
    tolerance for hidden views makes hulls too large."""
    count = int(part.sum())
    least = np.sort(agreeing[part])[-max(math.ceil(0.3 * count), 12)]
    return part & (agreeing >= least)


Track = list[tuple[float, Hull]]
"""Times, ascending, and hulls of a thing."""


def linked(times: Sequence[float], hulls: Sequence[Sequence[Hull]]) -> list[Track]:
    """Return the tracks among the ``hulls`` of each of ``times`` (ascending).

    Hulls are assigned to the tracks so far by the least total distance (Kuhn 1955), each within a
    gate around where constant velocity takes a track. A track may miss three times in a row; those
    found at fewer than four are left out.
    """
    from scipy.optimize import linear_sum_assignment

    tracks: list[Track] = []
    for i, (time, found) in enumerate(zip(times, hulls, strict=True)):
        current = [x for x in tracks if x[-1][0] >= times[max(i - 4, 0)]]
        distances = np.array([[_distance(x, time, y) for y in found] for x in current])
        pairs = zip(*linear_sum_assignment(distances), strict=True) if current and found else ()
        taken = {column: row for row, column in pairs if distances[row, column] < 1e3}
        for column, hull in enumerate(found):
            track = current[taken[column]] if column in taken else []
            if not track:
                tracks.append(track)
            track.append((time, hull))
    return [x for x in tracks if len(x) >= 4]


def _distance(track: Track, time: float, hull: Hull) -> float:
    """Return how far ``hull`` is from where ``track`` is expected, in radii of its gate, and how
    much larger or smaller it is; 1000 where it is another thing."""
    before, last = track[-1]
    usual = float(np.median([x.radius for _, x in track]))
    expected = last.center
    reach = 6 * last.radius
    if len(track) > 1:
        earlier, previous = track[-2]
        step = (time - before) / (before - earlier) * (last.center - previous.center)
        expected = expected + step
        reach = 3 * max(last.radius, usual) + 1.5 * float(np.linalg.norm(step))
    distance = float(np.linalg.norm(hull.center - expected)) / reach
    growth = abs(math.log(hull.radius / usual)) / 1.2
    return distance + growth if max(distance, growth) < 1 else 1e3


def travels(track: Track) -> bool:
    """Return whether a thing goes on and on: what turns or bends in place is no track to start
    from.

    Of two or more steps of at least a radius, successive ones must not mostly turn back; what hops
    does, too, but less often than noise.
    """
    radius = np.median([hull.radius for _, hull in track])
    places = [track[0][1].center]
    for _, hull in track:
        if np.linalg.norm(hull.center - places[-1]) >= radius:
            places.append(hull.center)
    steps: np.ndarray = np.diff(np.stack(places), axis=0)
    return len(steps) > 1 and (steps[1:] * steps[:-1]).sum() > -0.2 * (steps**2).sum()


def surface(hulls: Sequence[Hull]) -> tuple[np.ndarray, float]:
    """Return (C, 3) points on the surface of a thing, from its centre, and the distance between
    them.

    Cubes that lie in four tenths of its hulls belong to it; hulls of less than three quarters of
    the usual radius do not show all of it.
    """
    from scipy.spatial import KDTree

    radii = np.array([hull.radius for hull in hulls])
    whole = [x for x, radius in zip(hulls, radii, strict=True) if radius >= 0.75 * np.median(radii)]
    side = float(np.median([hull.side for hull in whole]))
    cells = [np.unique(np.round((x.cubes - x.center) / side), axis=0) for x in whole]
    cubes, counts = np.unique(np.concatenate(cells), axis=0, return_counts=True)
    often = counts >= 0.4 * len(whole)
    cubes = cubes[often] if often.any() else cubes
    beside = KDTree(cubes).query_pairs(1, p=1, output_type="ndarray")
    return cubes[np.bincount(beside.ravel(), minlength=len(cubes)) < 6] * side, side


@dataclass(frozen=True)
class TimedGaussians:
    """Gaussians that are there at one time."""

    time: float
    gaussians: Gaussians
    velocity: Tensor  # (3,) world units per clip


def hull_gaussians(
    views: Sequence[ChangedView],
    center: np.ndarray,
    outward: np.ndarray,
    side: float,
    num_terms: int,
) -> Gaussians:
    """Return Gaussians at the points ``outward`` (C, 3) of a thing's surface, from its ``center``,
    ``side`` apart.

    Each has the mean of its colours in the images in which it is on the side of the camera and the
    image changes there.
    """
    points = center + outward
    total = np.zeros((len(points), 3))
    count = np.zeros((len(points), 1))
    for view in views:
        towards = view.center - points
        lengths = np.linalg.norm(towards, axis=1) * np.linalg.norm(outward, axis=1)
        faces = (outward * towards).sum(1) > 0.3 * lengths
        rows = np.flatnonzero(faces & view.seen(points)[1])
        total[rows] += view.colours(points[rows])
        count[rows] += 1
    usual = total.sum(0) / max(count.sum(), 1)
    colours = np.where(count > 0, total / np.maximum(count, 1), usual)
    means = torch.from_numpy(points).float()
    base = torch.from_numpy((colours - 0.5) / SH_C0).float()
    return Gaussians.isotropic(means, math.log(0.6 * side), LOGIT, base, num_terms)


def pays(gaussians: Gaussians, time: float, clips: Sequence[FixedCameraClip]) -> bool:
    """Return whether ``gaussians``, drawn over the cameras' medians, leave less than nine tenths of
    the squared error of these to the images of ``time``.

    Over the pixels that they cover, in the images that change at four tenths of these: in others
    something hides the thing, which may be so in less than six tenths of the images. A false hull,
    where silhouettes of different things cross, does not pay.
    """
    before = after = 0.0
    looked_at = shown = 0
    for one in (one for one in clips if time in one.times):
        i = one.times.index(time)
        with torch.no_grad():
            drawn = render(gaussians, one.camera)
        alpha = drawn.alpha[0][..., None]
        covered = (alpha[..., 0] > 0.1) & torch.from_numpy(one.counted[i])
        if not bool(covered.any()):
            continue
        looked_at += 1
        if float(torch.from_numpy(one.changed[i])[covered].float().mean()) < 0.4:
            continue
        shown += 1
        truth, still = (torch.from_numpy(x).float() / 255 for x in (one.images[i], one.median))
        before += float((still - truth).square().sum(-1)[covered].sum())
        after += float((drawn.rgb[0] + (1 - alpha) * still - truth).square().sum(-1)[covered].sum())
    return shown >= 0.4 * looked_at and after < 0.9 * before


def surface_changes(
    clips: Sequence[FixedCameraClip], still: Gaussians, options: RenderOptions, limit: int
) -> list[TimedGaussians]:
    """Return copies of ``still`` Gaussians at the times at which most cameras see another colour
    there, in this colour.

    The change of a Gaussian is the median over cameras, two or more, of sum_p w_p (truth - median)
    / sum_p w_p with w = alpha T; that of what is only covered by something else differs from camera
    to camera. At most ``limit``, those that change most.
    """
    graphs = []
    for one in clips:
        flat = torch.zeros(len(still), 1, 3, requires_grad=True, device="cpu")
        blended = render(still.replace(sh=flat), one.camera, options).rgb[0]
        (sums,) = torch.autograd.grad(blended, flat, torch.ones_like(blended), retain_graph=True)
        graphs.append((flat, blended, sums[:, 0, :1]))
    times = sorted({time for one in clips for time in one.times})
    changes = torch.zeros(len(times), len(still), 3, device="cpu")
    for change, time in zip(changes, times, strict=True):
        seen: list[Tensor] = []
        for one, (flat, blended, weights) in zip(clips, graphs, strict=True):
            if time not in one.times:
                continue
            i = one.times.index(time)
            error = torch.from_numpy(one.images[i]).float() - torch.from_numpy(one.median).float()
            error = error / 255 * torch.from_numpy(one.counted[i])[..., None]
            (sums,) = torch.autograd.grad(blended, flat, error, retain_graph=True)
            # what covers less than a tenth of a pixel does not show
            seen.append(torch.where(weights > 0.1 * SH_C0, sums[:, 0] / weights, torch.nan))
        stacked = torch.stack(seen)
        several = (~stacked[..., 0].isnan()).sum(0) >= 2
        change[several] = stacked.nanmedian(0).values[several]
    sizes = changes.abs().amax(2)
    ordered = sizes[sizes > SMALLEST_CHANGE].sort(descending=True).values
    least = float(ordered[limit]) if len(ordered) > limit else SMALLEST_CHANGE
    towards = torch.cat([one.camera.centers for one in clips]).mean(0)
    return [
        TimedGaussians(
            time,
            _recoloured(still.select(size > least), change[size > least], towards),
            torch.zeros(3, device="cpu"),
        )
        for time, change, size in zip(times, changes, sizes, strict=True)
        if bool((size > least).any())
    ]


def _recoloured(gaussians: Gaussians, change: Tensor, towards: Tensor) -> Gaussians:
    """Return ``gaussians`` with other base colours, half a standard deviation before themselves as
    seen from ``towards`` (3,)."""
    shortest = torch.nn.functional.one_hot(gaussians.log_scales.argmin(1), 3).to(gaussians.means)
    normals = rotate(gaussians.quats, shortest)
    signs = ((towards - gaussians.means) * normals).sum(1, keepdim=True).sign()
    lift = 0.5 * gaussians.scales.amax(1, keepdim=True)
    sh = gaussians.sh.clone()
    sh[:, 0] += change / SH_C0
    logits = gaussians.logit_opacities.clamp_min(LOGIT)
    return gaussians.replace(
        means=gaussians.means + signs * lift * normals, sh=sh, logit_opacities=logits
    )


def first_motion(
    clips: Sequence[FixedCameraClip],
    still: Gaussians,
    extent: float,
    limit: int,
    options: RenderOptions,
) -> list[TimedGaussians]:
    """Return what changes before the cameras of ``clips``, where ``still`` Gaussians are or the
    cameras look, as Gaussians at single times.

    About ``limit`` on things, at most, and as many on still surfaces that look different at times.
    """
    if len(clips) < 2 or limit < 1:
        return []
    low, high = _box(clips, still, extent)
    times = sorted({time for one in clips for time in one.times})
    found: list[TimedGaussians] = []
    for track in linked(times, [hulls_in(views_at(clips, time), low, high) for time in times]):
        hulls = [hull for _, hull in track]
        goes_on = travels(track)
        usual = surface(hulls)
        pace = np.gradient([x.center for x in hulls], [time for time, _ in track], axis=0) * goes_on
        for (time, hull), velocity in zip(track, torch.from_numpy(pace).float(), strict=True):
            shape = usual if goes_on else surface([hull])
            views = views_at(clips, time)
            gaussians = hull_gaussians(views, hull.center, *shape, still.sh.shape[1])
            if pays(gaussians, time, clips):
                found.append(TimedGaussians(time, gaussians, velocity))
    factor = max(sum(len(one.gaussians) for one in found) / limit, 1)
    things = [replace(one, gaussians=_thinned(one.gaussians, factor)) for one in found]
    return [*things, *surface_changes(clips, still, options, limit)]


def _thinned(gaussians: Gaussians, factor: float) -> Gaussians:
    """Return one of ``factor`` Gaussians, evenly chosen, so much larger that they cover as much."""
    count = max(round(len(gaussians) / factor), 1)
    rows = torch.linspace(0, len(gaussians) - 1, count, device="cpu").round().long()
    kept = gaussians.select(rows)
    return kept.replace(log_scales=kept.log_scales + 0.5 * math.log(len(gaussians) / count))


def _box(
    clips: Sequence[FixedCameraClip], still: Gaussians, extent: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return two corners (3,) of a box with the still things and the cameras, and some room
    around."""
    center, half_size = (x.double().numpy() for x in box_of(still, extent))
    centers = np.concatenate([one.camera.centers.double().numpy() for one in clips])
    low = np.minimum(center - half_size, centers.min(0))
    high = np.maximum(center + half_size, centers.max(0))
    room = 0.25 * (high - low).max()
    return low - room, high + room
