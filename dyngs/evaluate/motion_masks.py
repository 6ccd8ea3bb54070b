"""Moving pixels of images, estimated from the images alone.

Images of a fixed camera are compared with their median over time. Other images are compared with
images of other times, warped by all depths of the sparse points around a pixel: a pixel moves if
two thirds of these images contradict every depth (plane sweep, Collins 1996). Differences within
half a pixel do not count (Birchfield and Tomasi 1998).

Local letters: H x W pixels, C channels, N other images.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, interpolate, max_pool2d, pad

from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, View, all_views
from dyngs.data.geometry import camera_center, focus_point, invert_rigid, project_points
from dyngs.data.images.images import read_mask
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import evenly_spaced, static_cameras
from dyngs.io.write import cache_folder, write_image

FEWEST_TIMES = 3  # Images of a fixed camera, or times of moving ones, that can be compared
MEDIAN_IMAGES = 31  # Images, spread over the clip, of which a camera's median is computed
MEDIAN_SIDE = 400  # Longest side of these images, px
# Mean channel difference from the camera's median image, in [0, 1], above which a pixel moves
CHANGE = 0.05

SWEEP_SIDE = 160  # Longest side of warped images, px
NEIGHBOURS = 12  # Images from near by, and as many spread over the clip
FEWEST_SEEING = 4  # Other images that must contain a pixel
NUM_DEPTHS = 32  # Depths, evenly spaced in inverse depth
NUM_POINTS = 12  # Sparse points, nearest in the image, whose depths are tried
MARGIN = 1.15  # Factor by which these depths are extended on either side
# Factor by which depths extend around the point that all cameras look at, without sparse points
OBJECT_MARGIN = 1.8
# Fraction of the other images that agree with a static pixel; others may be occluded
AGREEING = 0.35
# Error above which a pixel moves, and that each connected region must reach somewhere. Measured
# with AGREEING on `orbits` and `flag` against true masks, and by eye on clips.
LOW, HIGH = 0.008, 0.08
_DIGEST_BYTES = 1 << 16  # Bytes of each image file that count for the digest


class MotionMasks:
    """Masks of moving pixels of the views of a capture.

    Masks are stored in the cache, by a digest of the images, so that all runs are scored on the
    same pixels.

    Args:
        capture: all its splits are used.
        options: options of the capture; image sizes are ignored.
    """

    def __init__(self, capture: Capture, options: DataConfig) -> None:
        timed = [view for view in all_views(capture.splits) if view.time is not None]
        self._views = sorted(timed, key=lambda view: (view.name, view.time))
        self._indices = {view.image_path: i for i, view in enumerate(self._views)}
        self._points = None if capture.points is None else capture.points.xyz
        self._options = options
        self._fixed: dict[int, list[int]] = {}
        for indices in static_cameras(self._views):
            if len(indices) >= FEWEST_TIMES:
                self._fixed |= dict.fromkeys(indices, indices)
        self._medians: dict[int, Tensor] = {}

    def mask(self, view: View, width: int, height: int) -> Tensor | None:
        """Return the moving pixels (H, W) bool of a view.

        None with too few times to compare, or without sparse points if cameras move and do not look
        at one point.
        """
        index = self._indices.get(view.image_path)
        if index is None or len({each.time for each in self._views}) < FEWEST_TIMES:
            return None
        path = self._folder / f"{index:05d}.png"
        moving = None
        if path.is_file():
            with suppress(DyngsError):  # A damaged file is estimated again.
                moving = read_mask(path)
        if moving is None:
            moving = self._changed(index) if index in self._fixed else self._unexplained(index)
            if moving is None:
                return None
            write_image(path, (255 * moving).byte().numpy())
        resized = interpolate(moving[None, None].float(), (height, width), mode="bilinear")
        return resized[0, 0] >= 0.5

    @cached_property
    def _folder(self) -> Path:
        digest = hashlib.sha256()
        for view in self._views:
            digest.update(f"{view.name} {view.image_path.stat().st_size}".encode())
            with view.image_path.open("rb") as file:
                digest.update(file.read(_DIGEST_BYTES))
        return cache_folder("motion") / digest.hexdigest()[:16]

    def _loader(self, side: int) -> ImageLoader:
        size = {"downscale": 1.0, "longest_side": side}
        return ImageLoader(self._views, self._options.model_copy(update=size))

    @cached_property
    def _median_loader(self) -> ImageLoader:
        return self._loader(MEDIAN_SIDE)

    @cached_property
    def _small_images(self) -> list[_SmallImage]:
        loader = self._loader(SWEEP_SIDE)
        return [_SmallImage.of(loader[i]) for i in range(len(loader))]

    def _changed(self, index: int) -> Tensor:
        """Return the pixels (H, W) bool that differ from the median of a fixed camera."""
        indices = self._fixed[index]
        first = indices[0]
        if first not in self._medians:
            chosen = [indices[i] for i in evenly_spaced(len(indices), MEDIAN_IMAGES)]
            images = torch.stack([_channels(self._median_loader[i]) for i in chosen])
            self._medians[first] = images.median(dim=0).values
        change = (_channels(self._median_loader[index]) - self._medians[first]).abs().mean(0)
        return morphological_opening(change > CHANGE)

    def _unexplained(self, index: int) -> Tensor | None:
        """Return the pixels (H, W) bool that no depth explains in images of other times. None if
        the range of depths is unknown."""
        from scipy.ndimage import binary_fill_holes
        from skimage.filters import apply_hysteresis_threshold

        depths = self._inverse_depths(index)
        if depths is None:
            return None
        image = self._small_images[index]
        others = [self._small_images[i] for i in self._compared(index)]
        error = _smallest_error(image, others, *depths)
        if image.shown is not None:
            error = error * image.shown
        moving = torch.from_numpy(apply_hysteresis_threshold(error.numpy(), LOW, HIGH))
        closed = erode(_dilate(morphological_opening(moving), radius=2), radius=2)
        return torch.from_numpy(binary_fill_holes(closed.numpy()))

    def _compared(self, index: int) -> list[int]:
        """Return indices of the images of other times that are compared with one: images from near
        by, and others spread over the clip."""
        times = np.array([view.time for view in self._views], np.float64)
        centers = np.stack([camera_center(view.cam_from_world) for view in self._views])
        other = np.flatnonzero(times != times[index])
        distance = np.linalg.norm(centers[other] - centers[index], axis=1)
        near = other[np.argsort(distance, kind="stable")[: 2 * NEIGHBOURS : 2]]
        spread = other[evenly_spaced(len(other), NEIGHBOURS)]
        return sorted({int(i) for i in (*near, *spread)})

    def _inverse_depths(self, index: int) -> tuple[Tensor, Tensor] | None:
        """Return the smallest and largest inverse depth (H, W) of each pixel. None without sparse
        points and without a point that the cameras look at."""
        from scipy.spatial import KDTree

        view = self._views[index]
        height, width = self._small_images[index].rgb.shape[1:]
        if self._points is not None:
            positions, visible = project_points(self._points, view)
            if int(visible.sum()) >= NUM_POINTS:
                pose = view.cam_from_world
                depth = self._points[visible] @ pose[2, :3] + pose[2, 3]
                inverse = 1 / depth
                size = np.array([width, height])
                down, across = np.mgrid[:height, :width] + 0.5
                pixels = np.stack([across, down], axis=-1)
                nearest = KDTree(positions[visible] * size).query(pixels, k=NUM_POINTS)[1]
                found = np.sort(inverse[nearest], axis=-1)
                # One outlier on either side is ignored.
                low = found[..., 1] / MARGIN
                high = found[..., -2] * MARGIN
                return torch.from_numpy(low).float(), torch.from_numpy(high).float()
        poses = np.stack([invert_rigid(view.cam_from_world) for view in self._views])
        focus = focus_point(poses)
        if focus is None:
            return None
        distance = float(np.linalg.norm(focus - camera_center(view.cam_from_world)))
        one = torch.ones(height, width, device="cpu")
        return one / (OBJECT_MARGIN * distance), one * OBJECT_MARGIN / distance


@dataclass(frozen=True)
class _SmallImage:
    """Image (C, H, W) with its smallest and largest values within half a pixel, and its camera."""

    rgb: Tensor  # premultiplied, with alpha as a fourth channel if present
    shown: Tensor | None  # (H, W) alpha >= 0.5
    lowest: Tensor
    highest: Tensor
    pose: Tensor  # (4, 4) cam_from_world, float64
    intrinsics: Tensor  # (3, 3), float64

    @staticmethod
    def of(image: Image) -> _SmallImage:
        values = _channels(image)
        height, width = values.shape[1:]
        padded = pad(values[None], (1, 1, 1, 1), mode="replicate")[0]
        between = []
        for down in range(3):
            for across in range(3):
                shifted = padded[:, down : down + height, across : across + width]
                between.append((values + shifted) / 2)
        stacked = torch.stack(between)
        return _SmallImage(
            values,
            None if image.alpha is None else image.alpha >= 0.5,
            stacked.amin(0),
            stacked.amax(0),
            image.cameras.cam_from_world[0].double(),
            image.cameras.intrinsics[0].double(),
        )


def _smallest_error(
    image: _SmallImage, others: Sequence[_SmallImage], low: Tensor, high: Tensor
) -> Tensor:
    """Return the smallest error (H, W) of all depths.

    The error of a depth is a quantile over the other images of the colour difference, which is
    averaged over channels and 3x3 pixels. It is 0 where too few other images contain the pixel.

    Args:
        low, high: (H, W) range of inverse depth.
    """
    height, width = low.shape
    down, across = torch.meshgrid(
        torch.arange(height, device="cpu") + 0.5,
        torch.arange(width, device="cpu") + 0.5,
        indexing="ij",
    )
    pixels = torch.stack([across, down, torch.ones_like(down)], dim=-1).double()
    rays = pixels @ torch.linalg.inv(image.intrinsics).T
    world_from_cam = torch.linalg.inv(image.pose)
    # Homogeneous pixels of the other images are linear in the inverse depth.
    lines = []
    for other in others:
        relative = other.pose @ world_from_cam
        direction = (rays @ (other.intrinsics @ relative[:3, :3]).T).float()
        lines.append((direction, (other.intrinsics @ relative[:3, 3]).float()))
    smallest = torch.full((height, width), torch.inf, device="cpu")
    for step in torch.linspace(0, 1, NUM_DEPTHS, device="cpu"):
        inverse = low + step * (high - low)
        errors = []
        for other, (direction, origin) in zip(others, lines, strict=True):
            at = direction + origin * inverse[..., None]
            size = torch.tensor(other.rgb.shape[:0:-1], device="cpu")
            grid = 2 * at[..., :2] / at[..., 2:].clamp_min(1e-9) / size - 1
            bounds = torch.cat([other.lowest, other.highest])[None]
            sampled = grid_sample(bounds, grid[None], padding_mode="border", align_corners=False)
            lowest, highest = sampled[0].chunk(2)
            error = ((image.lowest - highest).relu() + (lowest - image.highest).relu()).mean(0)
            contains = (grid.abs() <= 1).all(-1) & (at[..., 2] > 0)
            errors.append(_mean_of_3x3(error, contains))
        smallest = torch.minimum(smallest, _quantile_of_finite(torch.stack(errors)))
    return torch.where(smallest.isfinite(), smallest, 0.0)


def _mean_of_3x3(error: Tensor, counts: Tensor) -> Tensor:
    """Return the mean (H, W) of ``error`` over the neighbours that count; inf at pixels that do
    not."""
    stacked = torch.stack([error * counts, counts.float()])[None]
    total, weight = avg_pool2d(stacked, 3, stride=1, padding=1)[0]
    return torch.where(counts, total / weight, torch.inf)


def _quantile_of_finite(errors: Tensor) -> Tensor:
    """Return the quantile ``AGREEING`` (H, W) of the finite values (N, H, W); inf for fewer than
    ``FEWEST_SEEING``."""
    count = errors.isfinite().sum(0)
    rank = ((count - 1).clamp_min(0) * AGREEING).round().long()
    quantile = errors.sort(dim=0).values.gather(0, rank[None])[0]
    return torch.where(count >= FEWEST_SEEING, quantile, torch.inf)


def _channels(image: Image) -> Tensor:
    """Return the premultiplied colours, and alpha if present, as (C, H, W)."""
    values = [image.rgb_premultiplied]
    if image.alpha is not None:
        values.append(image.alpha[..., None])
    return torch.cat(values, dim=-1).movedim(-1, 0)


def morphological_opening(shown: Tensor) -> Tensor:
    """Return the opening (H, W) bool of ``shown`` by 3 x 3 pixels."""
    return _dilate(erode(shown, radius=1), radius=1)


def _dilate(shown: Tensor, radius: int) -> Tensor:
    """Return the pixels (H, W) bool with a neighbour within ``radius`` that is ``shown``."""
    width = 2 * radius + 1
    found = max_pool2d(shown[None, None].float(), width, stride=1, padding=radius)
    return found[0, 0] > 0.5


def erode(shown: Tensor, radius: int) -> Tensor:
    """Return the pixels (H, W) bool whose neighbours within ``radius`` are all ``shown``."""
    return ~_dilate(~shown, radius)
