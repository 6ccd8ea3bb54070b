"""Plot of a capture's cameras and sparse points, which shows whether the poses make sense."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dyngs.data.capture import Capture, View
from dyngs.data.geometry import inverse_rigid, pose_fault
from dyngs.errors import DyngsError
from dyngs.files.outputs import Inputs
from dyngs.files.write import write_image

BACKGROUND = (24, 26, 30)
SPLIT_COLORS = {"train": (255, 170, 60), "val": (120, 230, 120), "test": (80, 190, 255), "pose": (80, 190, 255)}


def draw_cameras(capture: Capture, out: Path, size: int = 640) -> None:
    """Write an image of 2 ``size`` x ``size`` pixels: the scene from above and from the side, orthographic.

    Frusta of training cameras are orange, of validation green, of test and new poses blue; points have their colours.
    Up is the mean of the cameras' up axes. Points far beyond the cameras, and views without a rigid pose, are left out.
    """
    Inputs((capture.root,)).require_output(out)
    views = [(split, view) for split, views in capture.splits.items() for view in views]
    usable = [(split, view) for split, view in views if pose_fault(view) is None]
    if not usable:
        raise DyngsError(f"cannot draw the cameras of {capture.root}: no view has a usable pose")
    poses = np.stack([inverse_rigid(view.cam_from_world) for _, view in usable])
    axes = _drawing_axes(poses)
    xyz, rgb = _near_points(capture, poses[:, :3, 3])
    core = np.quantile(xyz @ axes.T, [0.03, 0.97], axis=0) if len(xyz) else xyz
    reach = np.concatenate([poses[:, :3, 3] @ axes.T, core])
    low, high = reach.min(axis=0), reach.max(axis=0)
    extent = max(float((high - low).max()) * 1.2, 1e-6)
    depth = extent * min(0.08, 0.4 / len(poses) ** 0.5)
    panels = []
    for title, horizontal, vertical in (("from above", 0, 1), ("from the side", 0, 2)):
        shown = [horizontal, vertical]
        middle = 0.5 * (low + high)[shown]
        panel = _Panel(size, axes[shown], middle, extent)
        panel.draw_points(xyz, rgb)
        for (split, view), pose in zip(usable, poses, strict=True):
            panel.draw_frustum(view, pose, depth, SPLIT_COLORS[split])
        panels.append(panel.finished(title))
    write_image(out, np.concatenate(panels, axis=1))


class _Panel:
    """One square of the plot, drawn at twice its size: ``extent`` units around ``center`` (2,), axes (2, 3)."""

    def __init__(self, size: int, axes: np.ndarray, center: np.ndarray, extent: float) -> None:
        from PIL import Image, ImageDraw

        self._size, self._axes, self._center, self._extent = size, axes, center, extent
        self._image = Image.new("RGB", (2 * size, 2 * size), BACKGROUND)
        self._draw = ImageDraw.Draw(self._image)

    def draw_points(self, xyz: np.ndarray, rgb: np.ndarray) -> None:
        for (x, y), colour in zip(self._places(xyz), np.maximum(rgb, 60).tolist(), strict=True):
            self._draw.rectangle((x, y, x + 1, y + 1), fill=tuple(colour))

    def draw_frustum(self, view: View, pose: np.ndarray, depth: float, color: tuple[int, int, int]) -> None:
        """Draw lines from the camera's centre to the corners of its image, and the image's border, ``depth`` away."""
        corners = np.array([[0, 0, 1], [view.width, 0, 1], [view.width, view.height, 1], [0, view.height, 1]], float)
        rays = corners @ np.linalg.inv(view.intrinsics).T
        rays *= depth / np.linalg.norm(rays, axis=1, keepdims=True)
        tips = self._places(np.concatenate([np.zeros((1, 3)), rays]) @ pose[:3, :3].T + pose[:3, 3])
        self._draw.line([tips[i] for i in (0, 1, 2, 0, 3, 4, 0)], fill=color, width=2)
        self._draw.line([tips[i] for i in (2, 3)], fill=color, width=2)
        self._draw.line([tips[i] for i in (4, 1)], fill=color, width=2)

    def finished(self, title: str) -> np.ndarray:
        """Return the (S, S, 3) uint8 panel with its title at the upper left."""
        from PIL import ImageFont

        self._draw.text((16, 12), title, fill=(204, 204, 204), font=ImageFont.load_default(28))
        return np.asarray(self._image.resize((self._size, self._size)))

    def _places(self, points: np.ndarray) -> list[tuple[float, float]]:
        """Return columns and rows of world points (P, 3); they may lie outside the panel."""
        flat = np.clip((points @ self._axes.T - self._center) / self._extent + 0.5, -10.0, 10.0)
        return [(x, y) for x, y in ((flat * (1, -1) + (0, 1)) * (2 * self._size - 1)).tolist()]


def _drawing_axes(poses: np.ndarray) -> np.ndarray:
    """Return (3, 3) rows right, back and up of the drawing: up is the cameras' mean up."""
    up = -poses[:, :3, 1].mean(axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-3 else np.array([0.0, 0.0, 1.0])
    lead = np.eye(3)[np.abs(up).argmin()]
    right = np.cross(lead, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def _near_points(capture: Capture, centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Up to about 20,000 points (P, 3) and colours: those within four camera spreads, or the nearer half."""
    if capture.points is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    xyz, rgb = capture.points.xyz, capture.points.rgb
    finite = np.isfinite(xyz).all(axis=1)
    xyz, rgb = xyz[finite], rgb[finite]
    middle = centers.mean(axis=0)
    distance = np.linalg.norm(xyz - middle, axis=1)
    spread = np.linalg.norm(centers - middle, axis=1).max()
    limit = max(4.0 * spread, float(np.median(distance)) if len(distance) else 0.0)
    near = np.flatnonzero(distance <= limit)
    near = near[:: max(len(near) // 20_000, 1)]
    return xyz[near], rgb[near]
