"""Two views of a person turned so that rows correspond, and the depth that a shift along a row
means.

Both cameras are turned, in place, to look at right angles to the line between them (Fusiello et al.
2000), and get a window each of the same focal length, around the person. A point at depth z is seen
in the left window at x0 = f X / z + cx0, in the right one at x1 = f (X - B) / z + cx1, B the
distance of the cameras. Its disparity f B / z is ``shift`` + d with shift = cx1 - cx0, which is
that of the middle of the person; d, the offset, is what the network finds. It is positive where the
surface is nearer than the middle, in both views: x1 = x0 - d, x0 = x1 + d.

Local letters: two views, left and right; windows of H x W pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.capture import View
from dyngs.data.geometry import camera_center
from dyngs.data.loader import Image

MIN_ANGLE, MAX_ANGLE = 5.0, 50.0
"""Degrees between the view axes of two views that suit; 45 in the paper."""
_BEST_ANGLE = 30.0  # Degrees that a pair should have that may be chosen freely
_LEVEL = 0.8  # Smallest cosine between the line from camera to camera and the rows of the images


def neighbours(name: str, views: Sequence[View], chosen: Sequence[int]) -> list[tuple[int, int]]:
    """Return pairs, left and right, of the ``chosen`` views that are next to each other on their
    ring, all around where it is closed.

    Raises DyngsError, for the capture ``name``: a view without a neighbour that suits.
    """
    ordered = order_around_person(views, chosen)
    steps = [*pairwise(ordered), *([(ordered[-1], ordered[0])] if len(ordered) > 2 else [])]
    pairs = [pair for step in steps if (pair := order_as_pair(views, *step)) is not None]
    alone = set(chosen) - {i for pair in pairs for i in pair}
    if alone:
        raise DyngsError(
            f"{name}: {views[min(alone)].name} has no neighbour to find depth with; give two views or more of one "
            f"moment, side by side, {MIN_ANGLE:g} to {MAX_ANGLE:g} degrees apart"
        )
    return pairs


def order_as_pair(views: Sequence[View], one: int, other: int) -> tuple[int, int] | None:
    """Return two views as left and right, as seen by both; None: depth cannot be found from
    them."""
    first = views[one]
    second = views[other]
    line = camera_center(second.cam_from_world) - camera_center(first.cam_from_world)
    across = first.cam_from_world[0, :3] + second.cam_from_world[0, :3]
    along = line @ across
    is_level = along and abs(along) >= _LEVEL * np.linalg.norm(line) * np.linalg.norm(across)
    is_near = MIN_ANGLE <= angle_between_views(first, second) <= MAX_ANGLE
    if not is_level or not is_near or (first.frame, first.time) != (second.frame, second.time):
        return None
    return (one, other) if along > 0 else (other, one)


def angle_between_views(one: View, other: View) -> float:
    """Return the angle between the view axes, degrees."""
    cosine = one.cam_from_world[2, :3] @ other.cam_from_world[2, :3]
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def order_around_person(views: Sequence[View], chosen: Sequence[int]) -> list[int]:
    """Return the ``chosen`` views in their order around the vertical, which is the mean of what is
    up in the images."""
    poses = np.stack([views[i].cam_from_world for i in chosen])
    up = -poses[:, 1, :3].mean(0)
    up = up / max(np.linalg.norm(up), 1e-12)
    outward = -poses[:, 2, :3]
    first = outward[0] - (outward[0] @ up) * up
    azimuth = np.arctan2(outward @ np.cross(up, first), outward @ first)
    return [chosen[i] for i in np.argsort(azimuth, kind="stable")]


def moments(views: Sequence[View]) -> dict[tuple[int | None, float | None], list[int]]:
    """Return the views of each moment, in their order around the person."""
    found: dict[tuple[int | None, float | None], list[int]] = {}
    for i, view in enumerate(views):
        found.setdefault((view.frame, view.time), []).append(i)
    return {moment: order_around_person(views, own) for moment, own in found.items()}


def spread(ring: Sequence[int], count: int, first: int = 0) -> list[int]:
    """Return ``count`` of the views of a ring, evenly around it from the one at ``first`` on."""
    return [ring[(first + round(i * len(ring) / count)) % len(ring)] for i in range(count)]


def spread_around_person(views: Sequence[View], count: int) -> list[int]:
    """Return ``count`` views, evenly around the person, at the first of the moments that most views
    show."""
    ring = max(moments(views).values(), key=len)
    return sorted(set(spread(ring, count)))


def best_pair(views: Sequence[View]) -> list[int]:
    """Return the two neighbours, of the moment that most views show, that suit depth best."""
    ring = max(moments(views).values(), key=len)
    pairs = [pair for pair in combinations(ring, 2) if order_as_pair(views, *pair) is not None]
    return list(
        min(
            pairs,
            key=lambda pair: abs(angle_between_views(views[pair[0]], views[pair[1]]) - _BEST_ANGLE),
            default=ring[:2],
        )
    )


def training_pairs(views: Sequence[View]) -> list[tuple[tuple[int, int], list[int]]]:
    """Return the pairs to train on, each with the views that stand between its two, of which there
    is at least one."""
    found = []
    for ring in moments(views).values():
        for start, first in enumerate(ring):
            for step in range(2, len(ring)):
                last = ring[(start + step) % len(ring)]
                if angle_between_views(views[first], views[last]) > MAX_ANGLE:
                    break
                pair = order_as_pair(views, first, last)
                if pair is not None:
                    between = [ring[(start + k) % len(ring)] for k in range(1, step)]
                    found.append((pair, between))
    return found


SIZE_MULTIPLE = 16
"""Windows are multiples of so many pixels."""
MIN_ALPHA = 0.5  # Alpha from which a pixel belongs to the person
_REACHED = 0.1  # Alpha from which a point may be part of the person: outlines are not cut off
_MARGIN = 8  # px around the person
_FEWEST = 16  # Pixels of a person that can be rectified
# Largest difference of the rows where the person begins or ends, relative to the person's height
_SAME_HEIGHT = 0.08
# Difference of depth, relative, from which neighbouring pixels belong to different surfaces
_EDGE = 0.01
_LARGEST = 4.0  # Largest width of a window, relative to the person's height


@dataclass(frozen=True)
class RectifiedPair:
    """Windows on a person in two views.

    Attributes:
        rgb: (2, 3, H, W) colours, not multiplied by alpha.
        alpha: (2, 1, H, W).
        offsets: (2, 1, H, W) true offset d in px, NaN where no depth map knows it.
        rect_from_world: (3, 3) rotation of both windows.
        centers: (2, 3) of the cameras in the world.
        focal: focal length of both windows, px.
        principal: (2, 2) cx and cy of the windows, px; the first pixel's centre is (0.5, 0.5); cy
            is the same.
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
        """(2, 1, H, W) bool: the pixels of the person."""
        return self.alpha > MIN_ALPHA

    @property
    def shift(self) -> Tensor:
        """() disparity of the middle of the person, px."""
        return self.principal[1, 0] - self.principal[0, 0]

    def depth(self, offsets: Tensor) -> Tensor:
        """Return the depth of ``offsets`` of any shape, px, in the axes of the windows, world
        units."""
        return self.focal * self.baseline / (self.shift + offsets)

    def seen_by_other(self, offsets: Tensor) -> Tensor:
        """Return the alpha (2, 1, H, W) of the other window where it shows what is at ``offsets``;
        differentiable."""
        height, width = offsets.shape[2:]
        sides = offsets.new_tensor([1.0, -1.0])[:, None, None]
        column = torch.arange(width, device=offsets.device) + 0.5 - sides * offsets[:, 0]
        row = (torch.arange(height, device=offsets.device) + 0.5)[:, None].expand_as(column)
        grid = torch.stack([2 * column / width - 1, 2 * row / height - 1], dim=-1)
        return grid_sample(self.alpha.flip(0), grid, align_corners=False)

    def points(self, depth: Tensor) -> Tensor:
        """Return the points (2, H, W, 3) in the world of all pixels at ``depth`` (2, 1, H, W)."""
        rays = _rays(self.principal, self.focal, (depth.shape[2], depth.shape[3]))
        return (depth[:, 0, ..., None] * rays) @ self.rect_from_world + self.centers[:, None, None]


def rectify_views(left: Image, right: Image, person_px: int) -> RectifiedPair:
    """Return the windows of two images in which the person is ``person_px`` pixels high.

    Raises DyngsError: no silhouettes, or views that do not show the same person from where their
    cameras say.
    """
    images = [_at_size(image, person_px) for image in (left, right)]
    poses = [image.cameras.cam_from_world[0].double() for image in images]
    centers = torch.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    across = torch.nn.functional.normalize(centers[1] - centers[0], dim=0)
    forward = poses[0][2, :3] + poses[1][2, :3]
    down = torch.nn.functional.normalize(torch.linalg.cross(forward, across), dim=0)
    turn = torch.stack([across, down, torch.linalg.cross(across, down)])
    boxes = torch.stack([_box(image, turn) for image in images])
    widths, heights = (boxes[..., 1] - boxes[..., 0]).amax(0).tolist()
    off = float((boxes[0, 1] - boxes[1, 1]).abs().max()) / heights
    is_before = boxes[0, 0].mean() > boxes[1, 0].mean()
    if off > _SAME_HEIGHT or not is_before or widths > _LARGEST * heights:
        raise DyngsError(
            f"{left.name} and {right.name}: do not show the same person where their cameras say (heights differ by "
            f"{off:.0%}); the calibration is wrong, or a mask is: see `dyngs data inspect`"
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
    windows = [_window(image, turn, ray) for image, ray in zip(images, rays, strict=True)]
    rgb, alpha, depth = (torch.stack(x) for x in zip(*windows, strict=True))
    shift = principal[1, 0] - principal[0, 0]
    return RectifiedPair(
        rgb=rgb,
        alpha=alpha,
        offsets=(focal * baseline / depth - shift).float(),
        rect_from_world=turn.float(),
        centers=centers.float(),
        focal=focal,
        principal=principal.float(),
        baseline=baseline,
    )


def _at_size(image: Image, person_px: int) -> Image:
    """Return the image shrunk by a whole number where the person is at least twice as high as
    ``person_px``."""
    if image.alpha is None or int((image.alpha > MIN_ALPHA).sum()) < _FEWEST:
        raise DyngsError(
            f"{image.name}: shows no silhouette of a person; add alpha or a mask of the person (`dyngs docs people`)"
        )
    rows = (image.alpha > MIN_ALPHA).any(1).nonzero()
    return image.downscaled(max(1, int(rows.max() - rows.min() + 1) // person_px))


def _box(image: Image, turn: Tensor) -> Tensor:
    """Return the lowest and highest x and y (2, 2) of the person in the turned camera, at depth
    1."""
    assert image.alpha is not None
    rows, columns = (image.alpha > MIN_ALPHA).nonzero(as_tuple=True)
    pixels = torch.stack([columns + 0.5, rows + 0.5, torch.ones_like(rows)], dim=1).double()
    camera = image.cameras
    inverse = torch.linalg.inv(camera.intrinsics[0].double())
    seen = pixels @ inverse.T @ camera.cam_from_world[0, :3, :3].double() @ turn.T
    flat = seen[:, :2] / seen[:, 2:]
    return torch.stack([flat.amin(0), flat.amax(0)], dim=1)


def _window(image: Image, turn: Tensor, rays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return colours (3, H, W), alpha (1, H, W) and depth (1, H, W; NaN unknown) along ``rays`` (H,
    W, 3)."""
    camera = image.cameras
    seen = rays @ turn @ camera.cam_from_world[0, :3, :3].double().T
    projected = seen @ camera.intrinsics[0].double().T
    size = projected.new_tensor([camera.width, camera.height])
    grid = (2 * projected[..., :2] / projected[..., 2:] / size - 1).float()[None]
    assert image.alpha is not None
    layers = torch.cat([image.rgb_premultiplied, image.alpha[..., None]], dim=2)
    layers = layers.permute(2, 0, 1)[None]
    sampled = grid_sample(layers, grid, align_corners=False)[0]
    rgb = sampled[:3] / sampled[3:].clamp_min(1e-3)
    if image.depth is None:
        return rgb.clamp(0, 1), sampled[3:], torch.full_like(sampled[3:], torch.nan)
    depth = _depth_at(image.depth, grid) / seen[None, ..., 2].float()
    return rgb.clamp(0, 1), sampled[3:], depth


def _depth_at(depth: Tensor, grid: Tensor) -> Tensor:
    """Return a depth map (h, w) at the places ``grid`` (1, H, W, 2) as (1, H, W); NaN where it is
    unknown.

    Inverse depth is linear on planes, and is interpolated; at edges, where that would lie on
    neither side, the nearest pixel counts.
    """
    known = depth > 0
    layers = torch.stack([torch.where(known, 1 / depth, 0), known.float()])[None]
    nearest = grid_sample(layers, grid, mode="nearest", align_corners=False)[0]
    linear = grid_sample(layers, grid, align_corners=False)[0]
    smooth = linear[:1] / linear[1:].clamp_min(1e-6)
    inverse = torch.where((smooth / nearest[:1] - 1).abs() < _EDGE, smooth, nearest[:1])
    return torch.where(nearest[1:] > 0, 1 / inverse, torch.nan)


def _rays(principal: Tensor, focal: float, size: tuple[int, int]) -> Tensor:
    """Return the rays (2, H, W, 3) through the pixels of the windows, at depth 1 in their axes."""
    pixels = (torch.arange(n, dtype=principal.dtype, device=principal.device) for n in size)
    rows, columns = (x + 0.5 for x in pixels)
    y = ((rows - principal[:, 1:]) / focal)[:, :, None].expand(-1, -1, size[1])
    x = ((columns - principal[:, :1]) / focal)[:, None].expand(-1, size[0], -1)
    return torch.stack([x, y, torch.ones_like(x)], dim=-1)


def is_inside(image: Image, points: Tensor) -> Tensor:
    """Return (N,) bool: whether an image shows the person, or reaches not, where ``points`` (N, 3)
    in the world are."""
    assert image.alpha is not None
    camera = image.cameras
    pose = camera.cam_from_world[0]
    flat = (points @ pose[:3, :3].T + pose[:3, 3]) @ camera.intrinsics[0].T
    size = flat.new_tensor([camera.width, camera.height])
    place = flat[:, :2] / flat[:, 2:].clamp_min(1e-9) / size
    beyond = (flat[:, 2] <= 0) | ((place < 0) | (place > 1)).any(1)
    grid = (2 * place - 1)[None, None]
    alpha = grid_sample(image.alpha[None, None], grid, align_corners=False)[0, 0, 0]
    return beyond | (alpha > _REACHED)


def crop_to_person(image: Image, margin: int) -> Image:
    """Return the part of an image, with its camera, that shows what is not transparent, and
    ``margin`` px around it."""
    assert image.alpha is not None
    rows, columns = ((image.alpha > 0).any(side).nonzero()[:, 0] for side in (1, 0))
    if not len(rows):
        return image
    (top, bottom), (left, right) = (
        (max(0, int(x[0]) - margin), min(size, int(x[-1]) + 1 + margin))
        for x, size in zip((rows, columns), image.alpha.shape, strict=True)
    )
    return crop_image(image, top, left, bottom - top, right - left)


def crop_image(image: Image, top: int, left: int, height: int, width: int) -> Image:
    """Return a part of an image, with its camera and maps, that begins at a row and column."""
    camera = image.cameras
    intrinsics = camera.intrinsics.clone()
    intrinsics[:, 0, 2] -= left
    intrinsics[:, 1, 2] -= top

    def part(x: Tensor) -> Tensor:
        return x[top : top + height, left : left + width].contiguous()

    names = ("alpha", "mask", "depth", "motion_mask", "labels", "flow")
    maps = {name: part(x) for name in names if (x := getattr(image, name)) is not None}
    return replace(
        image,
        cameras=Cameras(camera.cam_from_world, intrinsics, width, height),
        rgb_premultiplied=part(image.rgb_premultiplied),
        **maps,
    )
