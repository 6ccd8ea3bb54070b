"""Stereo pairs: choice of views, rectification, and conversion between disparity and depth.

Both cameras are rotated to look at right angles to the baseline (Fusiello et al. 2000), and get
crops of the same focal length around the person. A point at depth z is seen in the left crop at x0
= f X / z + cx0, in the right one at x1 = f (X - B) / z + cx1, with baseline B. Its disparity f B /
z is ``shift`` + d, where shift = cx1 - cx0 is that of the person's middle and the offset d is
predicted by the network. Offsets are positive in front of the middle: x1 = x0 - d.

Symbols: two views, left and right; crops of H x W pixels; N points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, normalize, pad

from dyngs.core.errors import DyngsError
from dyngs.data.capture import View
from dyngs.data.geometry import camera_center
from dyngs.data.loader import Image
from dyngs.human.avatar.observations import project_points
from dyngs.human.predict.people import image_planes, sample_maps
from dyngs.models.volume import camera_rays

MIN_ANGLE, MAX_ANGLE = 5.0, 50.0
"""Allowed angle between the view axes of a pair, degrees; 45 in the paper."""
_BEST_ANGLE = 30.0  # preferred angle of a pair, degrees
_MIN_LEVEL_COSINE = 0.8  # smallest cosine between the baseline and the image rows


def neighbour_pairs(
    name: str, views: Sequence[View], chosen: Sequence[int]
) -> list[tuple[int, int]]:
    """Return left-right pairs of the ``chosen`` views that are next to each other around the
    person.

    Raises DyngsError, for the capture ``name``: a view without a suitable neighbour.
    """
    ordered = order_around_person(views, chosen)
    found = [order_as_pair(views, *step) for step in pairwise([*ordered, ordered[0]])]
    pairs = [pair for pair in dict.fromkeys(found) if pair is not None]
    alone = set(chosen) - {i for pair in pairs for i in pair}
    if alone:
        raise DyngsError(
            f"{name}: {views[min(alone)].name} has no neighbouring view for stereo; give two or "
            f"more views of one time step, side by side, {MIN_ANGLE:g} to {MAX_ANGLE:g} degrees "
            "apart"
        )
    return pairs


def order_as_pair(views: Sequence[View], one: int, other: int) -> tuple[int, int] | None:
    """Return two views as (left, right); None if they do not suit as a stereo pair."""
    first = views[one]
    second = views[other]
    line = camera_center(second.cam_from_world) - camera_center(first.cam_from_world)
    across = first.cam_from_world[0, :3] + second.cam_from_world[0, :3]
    lengths = np.linalg.norm(line) * np.linalg.norm(across)
    cosine = line @ across / max(lengths, 1e-12)
    is_near = MIN_ANGLE <= angle_between_views(first, second) <= MAX_ANGLE
    is_level = abs(cosine) >= _MIN_LEVEL_COSINE
    if not is_level or not is_near or (first.frame, first.time) != (second.frame, second.time):
        return None
    return (one, other) if cosine > 0 else (other, one)


def angle_between_views(one: View, other: View) -> float:
    """Return the angle between the view axes, degrees."""
    cosine = one.cam_from_world[2, :3] @ other.cam_from_world[2, :3]
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def order_around_person(views: Sequence[View], chosen: Sequence[int]) -> list[int]:
    """Return the ``chosen`` views in their order around the mean up direction of the images."""
    poses = np.stack([views[i].cam_from_world for i in chosen])
    up = -poses[:, 1, :3].mean(0)
    up = up / max(np.linalg.norm(up), 1e-12)
    outward = -poses[:, 2, :3]
    first = outward[0] - (outward[0] @ up) * up
    azimuth = np.arctan2(outward @ np.cross(up, first), outward @ first)
    return [chosen[i] for i in np.argsort(azimuth, kind="stable")]


def rings_of_views(views: Sequence[View]) -> list[list[int]]:
    """Return the views of each time step, in their order around the person."""
    groups: dict[Any, list[int]] = {}
    for i, view in enumerate(views):
        groups.setdefault((view.frame, view.time), []).append(i)
    return [order_around_person(views, group) for group in groups.values()]


def spread(ring: Sequence[int], count: int, first: int = 0) -> list[int]:
    """Return ``count`` views of a ring, evenly spaced from the one at ``first``."""
    return [ring[(first + round(i * len(ring) / count)) % len(ring)] for i in range(count)]


def spread_around_person(views: Sequence[View], count: int) -> list[int]:
    """Return ``count`` views, evenly around the person, of the time step with the most views."""
    ring = max(rings_of_views(views), key=len)
    return sorted(set(spread(ring, count)))


def best_pair(views: Sequence[View]) -> list[int]:
    """Return the best stereo pair of the time step with the most views."""
    ring = max(rings_of_views(views), key=len)

    def deviation(pair: tuple[int, int]) -> float:
        one, other = pair
        return abs(angle_between_views(views[one], views[other]) - _BEST_ANGLE)

    pairs = [pair for pair in combinations(ring, 2) if order_as_pair(views, *pair) is not None]
    return list(min(pairs, key=deviation, default=ring[:2]))


def training_pairs(views: Sequence[View]) -> list[tuple[tuple[int, int], list[int]]]:
    """Return all training pairs, each with the views between its two, of which there is at least
    one."""
    pairs = []
    for ring in rings_of_views(views):
        for start, first in enumerate(ring):
            for step in range(2, len(ring)):
                last = ring[(start + step) % len(ring)]
                if angle_between_views(views[first], views[last]) > MAX_ANGLE:
                    break
                pair = order_as_pair(views, first, last)
                if pair is not None:
                    between = [ring[(start + k) % len(ring)] for k in range(1, step)]
                    pairs.append((pair, between))
    return pairs


SIDES = (1.0, -1.0)
"""Direction of a match's motion with its offset: left in the right view, right in the left."""
SIZE_MULTIPLE = 16
"""Sides of crops are multiples of this, px."""
MIN_ALPHA = 0.5  # alpha from which a pixel belongs to the person
_MIN_OUTLINE_ALPHA = 0.1  # the same for points, so that outlines are not cut off
_MARGIN = 8  # background around the person, px
_MIN_PIXELS = 16  # smallest area of a person
_MAX_ROW_DIFFERENCE = 0.08  # of the person between the views, relative to the height
_DEPTH_EDGE = 0.01  # relative depth difference of neighbouring pixels on different surfaces
_MAX_ASPECT = 4.0  # largest width of a crop relative to the person's height


@dataclass(frozen=True)
class RectifiedPair:
    """Rectified crops around the person in two views.

    Attributes:
        rgb: (2, 3, H, W) straight colours.
        alpha: (2, 1, H, W).
        offsets: (2, 1, H, W) true offset d, px; NaN where the depth is unknown.
        rect_from_world: (3, 3) rotation of both crops.
        centers: (2, 3) camera centres in the world.
        focal: focal length of both crops, px.
        principal: (2, 2) cx and cy of the crops, px; the first pixel's centre is (0.5, 0.5); cy is
            the same.
        baseline: distance of the cameras, world units.
    """

    rgb: Tensor
    alpha: Tensor
    offsets: Tensor
    rect_from_world: Tensor
    centers: Tensor
    focal: float
    principal: Tensor
    baseline: float

    @property
    def solid(self) -> Tensor:
        """Pixels of the person (2, 1, H, W), bool."""
        return self.alpha > MIN_ALPHA

    @property
    def shift(self) -> Tensor:
        """Disparity of the middle of the person (), px."""
        return self.principal[1, 0] - self.principal[0, 0]

    def depth(self, offsets: Tensor) -> Tensor:
        """Convert offsets of any shape, px, to depths along the view axis of the crops, world
        units."""
        return self.focal * self.baseline / (self.shift + offsets)

    def in_other_view(self, layers: Tensor, offsets: Tensor) -> Tensor:
        """Return ``layers`` (2, D, H, W) of the other crop at the match of each pixel, bilinear; 0
        outside; differentiable."""
        size = offsets.shape[2:]
        sides = offsets.new_tensor(SIDES)[:, None, None, None]
        moved = pad(sides * offsets[:, 0, ..., None], (0, 1))  # along the rows
        matches = _pixel_centres(size, offsets) - moved
        grid = 2 * matches / offsets.new_tensor(size[::-1]) - 1
        return grid_sample(layers.flip(0), grid, align_corners=False)

    def points(self, depth: Tensor) -> Tensor:
        """Return world points (2, H, W, 3) of all pixels at ``depth`` (2, 1, H, W)."""
        rays = _rays(self.principal, self.focal, depth.shape[2:])
        return (depth[:, 0, ..., None] * rays) @ self.rect_from_world + self.centers[:, None, None]


def rectify_views(left: Image, right: Image, person_px: int) -> RectifiedPair:
    """Rectify two images, with the person ``person_px`` pixels high.

    Raises DyngsError: no silhouettes, or the silhouettes do not match the cameras.
    """
    images = [_at_size(image, person_px) for image in (left, right)]
    poses = torch.cat([image.cameras.cam_from_world for image in images]).double()
    centers = -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0]
    across = normalize(centers[1] - centers[0], dim=0)
    forward = poses[:, 2, :3].sum(0)
    down = normalize(torch.linalg.cross(forward, across), dim=0)
    rotation = torch.stack([across, down, torch.linalg.cross(across, down)])
    boxes = torch.stack([_box(image, rotation) for image in images])
    widths, heights = (boxes[..., 1] - boxes[..., 0]).amax(0).tolist()
    row_difference = float((boxes[0, 1] - boxes[1, 1]).abs().max()) / heights
    is_before = boxes[0, 0].mean() > boxes[1, 0].mean()
    if row_difference > _MAX_ROW_DIFFERENCE or not is_before or widths > _MAX_ASPECT * heights:
        raise DyngsError(
            f"{left.name} and {right.name}: silhouettes do not match the cameras (rows differ by "
            f"{row_difference:.0%}); check the calibration and the masks with `dyngs data inspect`"
        )
    height = float(boxes[:, 1, 1].max() - boxes[:, 1, 0].min())
    focal = person_px / height
    rows, columns = (
        SIZE_MULTIPLE * math.ceil((focal * side + 2 * _MARGIN) / SIZE_MULTIPLE)
        for side in (height, widths)
    )
    middle = torch.stack([boxes[:, 0].mean(1), boxes[:, 1].mean().expand(2)], dim=1)
    half = torch.tensor([columns / 2, rows / 2], dtype=torch.float64, device="cpu")
    principal = half - focal * middle
    rays = _rays(principal, focal, (rows, columns))
    baseline = float((centers[1] - centers[0]).norm())
    crops = [_window(image, rotation, ray) for image, ray in zip(images, rays, strict=True)]
    rgb, alpha, depth = (torch.stack(x) for x in zip(*crops, strict=True))
    shift = principal[1, 0] - principal[0, 0]
    return RectifiedPair(
        rgb=rgb,
        alpha=alpha,
        offsets=(focal * baseline / depth - shift).float(),
        rect_from_world=rotation.float(),
        centers=centers.float(),
        focal=focal,
        principal=principal.float(),
        baseline=baseline,
    )


def _at_size(image: Image, person_px: int) -> Image:
    """Downscale the image by an integer if the person is at least twice ``person_px`` high."""
    if image.alpha is None or int((image.alpha > MIN_ALPHA).sum()) < _MIN_PIXELS:
        raise DyngsError(
            f"{image.name}: no silhouette of a person; add alpha or a mask of the person, see "
            "`dyngs docs people`"
        )
    rows = (image.alpha > MIN_ALPHA).any(1).nonzero()
    return image.downscaled(max(1, int(rows[-1] - rows[0] + 1) // person_px))


def _box(image: Image, rotation: Tensor) -> Tensor:
    """Return the extent in x and y (2, 2) of the person in the rotated camera, at depth 1."""
    pixels = (image_planes(image)[3].flatten() > MIN_ALPHA).nonzero()[:, 0]
    rays, _ = camera_rays(image.cameras.to(dtype=torch.float64), pixels)
    local = rays.directions @ rotation.T
    flat = local[:, :2] / local[:, 2:]
    return torch.stack([flat.amin(0), flat.amax(0)], dim=1)


def _window(image: Image, rotation: Tensor, rays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Resample an image along ``rays`` (H, W, 3); return colours (3, H, W), alpha and depth (1, H,
    W; NaN unknown)."""
    camera = image.cameras
    directions = rays @ rotation @ camera.cam_from_world[0, :3, :3].double().T
    projected = directions @ camera.intrinsics[0].double().T
    size = projected.new_tensor([camera.width, camera.height])
    grid = (2 * projected[..., :2] / projected[..., 2:] / size - 1).float()[None]
    sampled = grid_sample(image_planes(image)[None], grid, align_corners=False)[0]
    alpha = sampled[3:]
    rgb = (sampled[:3] / alpha.clamp_min(1e-3)).clamp(0, 1)
    if image.depth is None:
        return rgb, alpha, torch.full_like(alpha, torch.nan)
    return rgb, alpha, _depth_at(image.depth, grid) / directions[None, ..., 2].float()


def _depth_at(depth: Tensor, grid: Tensor) -> Tensor:
    """Sample a depth map (h, w) at positions ``grid`` (1, H, W, 2); return (1, H, W), NaN where
    unknown.

    Inverse depth, which is linear on planes, is interpolated; at edges the nearest pixel is used.
    """
    known = depth > 0
    layers = torch.stack([torch.where(known, 1 / depth, 0), known.float()])[None]
    nearest = grid_sample(layers, grid, mode="nearest", align_corners=False)[0]
    linear = grid_sample(layers, grid, align_corners=False)[0]
    smooth = linear[:1] / linear[1:].clamp_min(1e-6)
    inverse = torch.where((smooth / nearest[:1] - 1).abs() < _DEPTH_EDGE, smooth, nearest[:1])
    return torch.where(nearest[1:] > 0, 1 / inverse, torch.nan)


def _rays(principal: Tensor, focal: float, size: Sequence[int]) -> Tensor:
    """Return the rays (2, H, W, 3) through the pixels of the crops, at depth 1."""
    flat = (_pixel_centres(size, principal) - principal[:, None, None]) / focal
    return pad(flat, (0, 1), value=1.0)


def _pixel_centres(size: Sequence[int], like: Tensor) -> Tensor:
    """Return columns and rows (H, W, 2) of the centres of H x W pixels."""
    rows, columns = (torch.arange(side, device=like.device) + 0.5 for side in size)
    return torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)


def is_inside(image: Image, points: Tensor) -> Tensor:
    """Return the points (N,) bool that an image shows as the person, or that lie outside the
    image."""
    planes = image_planes(image)
    pixels, _, in_frame = project_points(points, image.cameras)
    grid = 2 * pixels / pixels.new_tensor(planes.shape[:0:-1]) - 1
    alpha = sample_maps(planes[None, 3:], grid[None])[0, :, 0]
    return ~in_frame | (alpha > _MIN_OUTLINE_ALPHA)
