"""Plot of a capture's cameras and sparse points, which shows whether the poses make sense."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dyngs.data.capture import Capture, View
from dyngs.data.geometry.poses import inverse_rigid, pose_fault
from dyngs.errors import DyngsError
from dyngs.files.outputs import Inputs
from dyngs.files.write import write_image

BACKGROUND = np.array([24, 26, 30], np.uint8)
SPLIT_COLORS = {"train": (255, 170, 60), "val": (120, 230, 120), "test": (80, 190, 255), "pose": (80, 190, 255)}


def draw_cameras(capture: Capture, out: Path, size: int = 640) -> None:
    """Write an image of 2 ``size`` x ``size`` pixels: the scene from above and from the side, orthographic.

    Frusta of training cameras are orange, of validation green, of test and new poses blue; points have their colours.
    Up is the mean of the cameras' up axes. Points far beyond the cameras, and views without a rigid pose, are left out.

    Raises:
        DyngsError: no view has a usable pose, or the file cannot be written.
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
        panel = _Panel(np.tile(BACKGROUND, (size, size, 1)), axes[shown], middle, extent)
        _draw_points(panel, xyz, rgb)
        for (split, view), pose in zip(usable, poses, strict=True):
            _draw_frustum(panel, view, pose, depth, SPLIT_COLORS[split])
        _write_title(panel.pixels, title)
        panels.append(panel.pixels)
    write_image(out, np.concatenate(panels, axis=1))


@dataclass(frozen=True)
class _Panel:
    """One square of the plot: ``pixels`` (S, S, 3) show ``extent`` units around ``center`` (2,), axes (2, 3)."""

    pixels: np.ndarray
    axes: np.ndarray
    center: np.ndarray
    extent: float

    def place(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns (P,) int of world points (P, 3); they may lie outside the panel."""
        size = len(self.pixels)
        flat = (points @ self.axes.T - self.center) / self.extent + 0.5
        inside = np.clip(flat, -10.0, 10.0)
        return ((1 - inside[:, 1]) * (size - 1)).round().astype(int), (inside[:, 0] * (size - 1)).round().astype(int)


def _drawing_axes(poses: np.ndarray) -> np.ndarray:
    """(3, 3) rows right, back and up of the drawing: up is the cameras' mean up."""
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


def _draw_points(panel: _Panel, xyz: np.ndarray, rgb: np.ndarray) -> None:
    rows, columns = panel.place(xyz)
    size = len(panel.pixels)
    inside = (rows >= 0) & (rows < size) & (columns >= 0) & (columns < size)
    panel.pixels[rows[inside], columns[inside]] = np.maximum(rgb[inside], 60)


def _draw_frustum(panel: _Panel, view: View, pose: np.ndarray, depth: float, color: tuple[int, int, int]) -> None:
    """Lines from the camera's centre to the corners of its image, and the image's border, ``depth`` away."""
    from skimage.draw import line_aa

    corners = np.array([[0, 0, 1], [view.width, 0, 1], [view.width, view.height, 1], [0, view.height, 1]], float)
    rays = corners @ np.linalg.inv(view.intrinsics).T
    rays *= depth / np.linalg.norm(rays, axis=1, keepdims=True)
    tips = np.concatenate([np.zeros((1, 3)), rays]) @ pose[:3, :3].T + pose[:3, 3]
    rows, columns = panel.place(tips)
    size = len(panel.pixels)
    for a, b in ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)):
        r, c, weight = line_aa(rows[a], columns[a], rows[b], columns[b])
        inside = (r >= 0) & (r < size) & (c >= 0) & (c < size)
        r, c, weight = r[inside], c[inside], 0.8 * weight[inside, None]
        panel.pixels[r, c] = ((1 - weight) * panel.pixels[r, c] + weight * np.array(color)).astype(np.uint8)


def _write_title(pixels: np.ndarray, text: str) -> None:
    """Draw ``text`` at the upper left, in place; nothing where no font is installed."""
    import OpenImageIO as oiio

    canvas = oiio.ImageBuf(np.ascontiguousarray(pixels))
    if oiio.ImageBufAlgo.render_text(canvas, 8, 20, text, 14, textcolor=(0.8, 0.8, 0.8)):
        pixels[:] = canvas.get_pixels(oiio.UINT8)
