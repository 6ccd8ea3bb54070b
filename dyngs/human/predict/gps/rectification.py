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


@dataclass(frozen=True)
class Pair:
    """Indices of two views, of which ``left`` stands on the left as seen by both."""

    left: int
    right: int


def neighbours(name: str, views: Sequence[View], chosen: Sequence[int]) -> list[Pair]:
    """Return pairs of the ``chosen`` views that are next to each other on their ring, all around
    where it is closed.

    Raises DyngsError, for the capture ``name``: fewer than two views, or one without a neighbour
    that suits.
    """
    if len(chosen) < 2:
        raise DyngsError(
            f"{name}: depth comes from two neighbouring views at least, not one; give --views A,B"
        )
    ordered = around(views, chosen)
    steps = [*pairwise(ordered), *([(ordered[-1], ordered[0])] if len(ordered) > 2 else [])]
    faults = {step: fault(views[step[0]], views[step[1]]) for step in steps}
    pairs = [_pair(views, *step) for step in steps if faults[step] is None]
    alone = set(chosen) - {i for pair in pairs for i in (pair.left, pair.right)}
    for step in steps:
        if faults[step] is not None and alone.intersection(step):
            a, b = (views[i].name for i in step)
            raise DyngsError(f"{name}: {a} and {b} {faults[step]}")
    return pairs


def fault(one: View, other: View) -> str | None:
    """Return why depth cannot be found from two views, to follow their names; None: it can."""
    if one.frame != other.frame or one.time != other.time:
        return "show two moments; give views of the same one"
    apart = angle(one, other)
    if apart > MAX_ANGLE:
        return f"look from directions {apart:.0f} degrees apart; give neighbours, at most {MAX_ANGLE:g} degrees apart"
    line = camera_center(other.cam_from_world) - camera_center(one.cam_from_world)
    if apart < MIN_ANGLE or np.linalg.norm(line) == 0:
        return f"look from the same direction, {apart:.1f} degrees apart; give two at least {MIN_ANGLE:g} degrees apart"
    across = one.cam_from_world[0, :3] + other.cam_from_world[0, :3]
    if abs(line @ across) < _LEVEL * np.linalg.norm(line) * np.linalg.norm(across):
        return "do not stand side by side; give two whose images have the other camera on the left or right"
    return None


def angle(one: View, other: View) -> float:
    """Return the angle between the view axes, degrees."""
    return float(
        np.degrees(
            np.arccos(np.clip(one.cam_from_world[2, :3] @ other.cam_from_world[2, :3], -1, 1))
        )
    )


def around(views: Sequence[View], chosen: Sequence[int]) -> list[int]:
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
    return {moment: around(views, own) for moment, own in found.items()}


def well_spread(views: Sequence[View], count: int) -> list[int]:
    """Return ``count`` views of the moment that most views show: two neighbours, or some evenly
    around the ring."""
    ordered = max(moments(views).values(), key=len)
    if count != 2:
        return sorted(
            {ordered[round(i * len(ordered) / count) % len(ordered)] for i in range(count)}
        )
    pairs = [(a, b) for a, b in combinations(ordered, 2) if fault(views[a], views[b]) is None]
    by_angle = sorted(
        pairs, key=lambda pair: abs(angle(views[pair[0]], views[pair[1]]) - _BEST_ANGLE)
    )
    return list(by_angle[0]) if by_angle else ordered[:2]


def lessons(views: Sequence[View]) -> list[tuple[Pair, list[int]]]:
    """Return the pairs to train on, each with the views that stand between its two, of which there
    is at least one."""
    found: list[tuple[Pair, list[int]]] = []
    for ring in moments(views).values():
        for start, first in enumerate(ring):
            for step in range(2, len(ring)):
                last = ring[(start + step) % len(ring)]
                if angle(views[first], views[last]) > MAX_ANGLE:
                    break
                if fault(views[first], views[last]) is None:
                    between = [ring[(start + k) % len(ring)] for k in range(1, step)]
                    found.append((_pair(views, first, last), between))
    return found


def _pair(views: Sequence[View], one: int, other: int) -> Pair:
    line = camera_center(views[other].cam_from_world) - camera_center(views[one].cam_from_world)
    across = views[one].cam_from_world[0, :3] + views[other].cam_from_world[0, :3]
    return Pair(one, other) if line @ across > 0 else Pair(other, one)


FACTOR = 16
"""Windows are multiples of so many pixels."""
SOLID = 0.5  # Alpha from which a pixel belongs to the person
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
        offsets: (2, 1, H, W) true offset d in px, NaN where no depth map knows it; None without
            depth maps.
        rect_from_world: (3, 3) rotation of both windows.
        centers: (2, 3) of the cameras in the world.
        focal: focal length of both windows, px.
        principal: (2, 2) cx and cy of the windows, px; the first pixel's centre is (0.5, 0.5); cy
            is the same.
        baseline: distance of the cameras, world units.
    """

    rgb: Tensor
    alpha: Tensor
    offsets: Tensor | None
    rect_from_world: Tensor
    centers: Tensor
    focal: float
    principal: Tensor
    baseline: float

    @property
    def solid(self) -> Tensor:
        """(2, 1, H, W) bool: the pixels of the person."""
        return self.alpha > SOLID

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


def rectified(left: Image, right: Image, person_px: int) -> RectifiedPair:
    """Return the windows of two images in which the person is ``person_px`` pixels high.

    Raises DyngsError: no silhouettes, or views that do not show the same person from where their
    cameras say.
    """
    images = [_at_size(image, person_px) for image in (left, right)]
    poses = [image.cameras.cam_from_world[0].double() for image in images]
    centers = torch.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    turn = _turn(centers, poses[0][2, :3] + poses[1][2, :3])
    boxes = torch.stack([_box(image, turn) for image in images])
    _require_same_person(boxes, left.name, right.name)
    height = float(boxes[:, 1, 1].max() - boxes[:, 1, 0].min())
    focal = person_px / height
    size = [
        _rounded(focal * height),
        _rounded(focal * float((boxes[:, 0, 1] - boxes[:, 0, 0]).max())),
    ]
    middle = torch.stack([boxes[:, 0].mean(1), boxes[:, 1].mean().expand(2)], dim=1)
    principal = (
        torch.tensor([size[1] / 2, size[0] / 2], dtype=torch.float64, device="cpu") - focal * middle
    )
    rays = _rays(principal, focal, (size[0], size[1]))
    baseline = float((centers[1] - centers[0]).norm())
    windows = [_window(image, turn, ray) for image, ray in zip(images, rays, strict=True)]
    depth = None if any(x.depth is None for x in images) else torch.stack([x[2] for x in windows])
    shift = principal[1, 0] - principal[0, 0]
    return RectifiedPair(
        rgb=torch.stack([x[0] for x in windows]),
        alpha=torch.stack([x[1] for x in windows]),
        offsets=None if depth is None else (focal * baseline / depth - shift).float(),
        rect_from_world=turn.float(),
        centers=centers.float(),
        focal=focal,
        principal=principal.float(),
        baseline=baseline,
    )


def _at_size(image: Image, person_px: int) -> Image:
    """Return the image shrunk by a whole number where the person is at least twice as high as
    ``person_px``."""
    if image.alpha is None or int((image.alpha > SOLID).sum()) < _FEWEST:
        raise DyngsError(
            f"{image.name}: shows no silhouette of a person; give it alpha or a mask of the person, see docs/human.md"
        )
    rows = (image.alpha > SOLID).any(1).nonzero()
    return image.shrunk(max(1, int(rows.max() - rows.min() + 1) // person_px))


def _turn(centers: Tensor, forward: Tensor) -> Tensor:
    """Return the rotation (3, 3) to axes along the line from left to right ``centers`` (2, 3), down
    and forward."""
    across = torch.nn.functional.normalize(centers[1] - centers[0], dim=0)
    down = torch.nn.functional.normalize(torch.linalg.cross(forward, across), dim=0)
    return torch.stack([across, down, torch.linalg.cross(across, down)])


def _box(image: Image, turn: Tensor) -> Tensor:
    """Return the lowest and highest x and y (2, 2) of the person in the turned camera, at depth
    1."""
    assert image.alpha is not None
    rows, columns = (image.alpha > SOLID).nonzero(as_tuple=True)
    pixels = torch.stack([columns + 0.5, rows + 0.5, torch.ones_like(rows)], dim=1).double()
    camera = image.cameras
    inverse = torch.linalg.inv(camera.intrinsics[0].double())
    seen = pixels @ inverse.T @ camera.cam_from_world[0, :3, :3].double() @ turn.T
    if bool((seen[:, 2] <= 0).any()):
        raise DyngsError(
            f"{image.name}: looks along the line to the other camera; give two that look the same way"
        )
    flat = seen[:, :2] / seen[:, 2:]
    return torch.stack([flat.amin(0), flat.amax(0)], dim=1)


def _require_same_person(boxes: Tensor, left: str, right: str) -> None:
    """Raise where the ``boxes`` (2, 2, 2) of one person cannot be that of both views."""
    height = (boxes[:, 1, 1] - boxes[:, 1, 0]).max()
    off = float((boxes[0, 1] - boxes[1, 1]).abs().max() / height)
    if off > _SAME_HEIGHT:
        raise DyngsError(
            f"{left} and {right}: by their cameras the person begins or ends at other heights, {off:.0%} of the person "
            "apart; the calibration is wrong, a mask is, or they do not show the same: see `dyngs data inspect`"
        )
    if not float(boxes[0, 0].mean() - boxes[1, 0].mean()) > 0:
        raise DyngsError(
            f"{left} and {right}: what they show of the person lies behind the cameras; the calibration is wrong, or "
            "they do not show the same"
        )
    if float((boxes[:, 0, 1] - boxes[:, 0, 0]).max()) > _LARGEST * float(height):
        raise DyngsError(
            f"{left} and {right}: the person is {_LARGEST:g} times as wide as high; is a mask wrong?"
        )


def _window(image: Image, turn: Tensor, rays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return colours (3, H, W), alpha (1, H, W) and depth (1, H, W; NaN unknown) along ``rays`` (H,
    W, 3)."""
    camera = image.cameras
    seen = rays @ turn @ camera.cam_from_world[0, :3, :3].double().T
    projected = seen @ camera.intrinsics[0].double().T
    grid = (
        2
        * projected[..., :2]
        / projected[..., 2:]
        / projected.new_tensor([camera.width, camera.height])
        - 1
    )
    grid = grid.float()[None]
    alpha = torch.ones_like(image.rgb_premultiplied[..., 0]) if image.alpha is None else image.alpha
    layers = torch.cat([image.rgb_premultiplied, alpha[..., None]], dim=2).permute(2, 0, 1)[None]
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
    rows = torch.arange(size[0], dtype=principal.dtype, device=principal.device) + 0.5
    columns = torch.arange(size[1], dtype=principal.dtype, device=principal.device) + 0.5
    y = ((rows - principal[:, 1:]) / focal)[:, :, None].expand(-1, -1, size[1])
    x = ((columns - principal[:, :1]) / focal)[:, None].expand(-1, size[0], -1)
    return torch.stack([x, y, torch.ones_like(x)], dim=-1)


def _rounded(pixels: float) -> int:
    return int(-(-(pixels + 2 * _MARGIN) // FACTOR) * FACTOR)


def is_inside(image: Image, points: Tensor) -> Tensor:
    """Return (N,) bool: whether an image shows the person, or reaches not, where ``points`` (N, 3)
    in the world are."""
    assert image.alpha is not None
    camera = image.cameras
    pose = camera.cam_from_world[0]
    flat = (points @ pose[:3, :3].T + pose[:3, 3]) @ camera.intrinsics[0].T
    place = (
        flat[:, :2] / flat[:, 2:].clamp_min(1e-9) / flat.new_tensor([camera.width, camera.height])
    )
    beyond = (flat[:, 2] <= 0) | ((place < 0) | (place > 1)).any(1)
    alpha = grid_sample(image.alpha[None, None], (2 * place - 1)[None, None], align_corners=False)[
        0, 0, 0
    ]
    return beyond | (alpha > _REACHED)


def cropped(image: Image, margin: int) -> Image:
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
    return cut_out(image, top, left, bottom - top, right - left)


def cut_out(image: Image, top: int, left: int, height: int, width: int) -> Image:
    """Return a part of an image, with its camera and maps, that begins at a row and column."""
    camera = image.cameras
    intrinsics = camera.intrinsics.clone()
    intrinsics[:, 0, 2] -= left
    intrinsics[:, 1, 2] -= top

    def part(x: Tensor) -> Tensor:
        return x[top : top + height, left : left + width].contiguous()

    names = ("alpha", "mask", "depth", "moves", "labels", "flow")
    maps = {name: part(x) for name in names if (x := getattr(image, name)) is not None}
    return replace(
        image,
        cameras=Cameras(camera.cam_from_world, intrinsics, width, height),
        rgb_premultiplied=part(image.rgb_premultiplied),
        **maps,
    )
