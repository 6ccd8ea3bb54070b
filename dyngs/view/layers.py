"""Images of a scene for the viewer: colour, depth, normals, opacity, error to the true image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0
from dyngs.export.camera_paths import resize_cameras
from dyngs.export.images import color_map, depth_to_rgb
from dyngs.gaussians.levels import LevelScene
from dyngs.gaussians.scene import GaussianScene
from dyngs.io.write import to_uint8
from dyngs.models.renderable import Rendering, TimeStep
from dyngs.runs.opened import OpenedScene
from dyngs.view.views import views_of

Layer = Literal["colour", "depth", "normal", "alpha", "error"]
Part = Literal["all", "moving", "static"]
LAYERS: tuple[Layer, ...] = get_args(Layer)
PARTS: tuple[Part, ...] = get_args(Part)


@dataclass(frozen=True)
class ViewRequest:
    """An image to render.

    Attributes:
        camera: one camera, of the size of the image.
        layer: displayed quantity. "error" needs ``view``.
        view: view of the capture whose camera, time and true image are used. None shows no true
            image.
        divide: fraction of the width that shows the rendering, with the true image on its right.
        background: colour (R, G, B) from 0 to 255. None uses that of the scene.
        is_moving: part of an animation, so levels of detail are used if available.
    """

    camera: Cameras
    time: float | None = None
    layer: Layer = "colour"
    part: Part = "all"
    view: int | None = None
    divide: float = 1.0
    background: tuple[int, int, int] | None = None
    is_moving: bool = False

    def behind(self, opened: OpenedScene) -> Tensor:
        """Return the background colour (3,) in [0, 1]."""
        if self.background is None:
            return opened.background
        return torch.tensor(self.background, device="cpu") / 255


def draw(opened: OpenedScene, request: ViewRequest) -> np.ndarray:
    """Return the image (H, W, 3) uint8 of a request."""
    request = with_camera_of_view(opened, request)
    rgb = highlight_selection(opened, request, _layer(opened, request))
    if request.view is None:
        return rgb
    size = request.camera.width, request.camera.height
    truth = truth_in_window(opened, request.view, size, request.behind(opened))
    if truth is None:
        return rgb
    outside = truth[..., 3:] == 0
    truth = truth[..., :3]
    if request.layer == "error":
        difference = np.abs(rgb.astype(np.float32) - truth) * ~outside / 255.0
        return color_map(4.0 * difference.mean(axis=2), "magma")
    rgb = np.where(outside, rgb // 2, rgb)  # darken pixels without truth
    composed = np.where(outside, rgb, truth)
    column = round(min(max(request.divide, 0.0), 1.0) * size[0])
    composed[:, :column] = rgb[:, :column]
    if 0 < column < size[0]:
        composed[:, max(column - 1, 0) : column + 1] = (255, 200, 0)
    return composed


def with_camera_of_view(opened: OpenedScene, request: ViewRequest) -> ViewRequest:
    """Return the request with camera and time of its view of the capture, if it has one."""
    if request.view is None:
        return request
    views = views_of(opened)
    size = request.camera.width, request.camera.height
    camera = resize_cameras(views.cameras[request.view], *size)
    return replace(request, camera=camera, time=views.views[request.view].time)


def mark_selection(opened: OpenedScene, selected: Tensor) -> None:
    """Highlight Gaussians in all images of a scene that was not drawn before.

    Args:
        selected: (N,) bool.
    """
    scene: GaussianScene = opened.scene
    sh = torch.zeros_like(scene.gaussians.sh)
    sh[:, 0] = torch.where(selected.to(sh.device), 0.5, -0.5)[:, None] / SH_C0
    mask = replace(scene, gaussians=scene.gaussians.replace(sh=sh), colour=None)
    opened.once("selection", lambda: opened.with_scene(mask))


def highlight_selection(opened: OpenedScene, request: ViewRequest, rgb: np.ndarray) -> np.ndarray:
    """Return ``rgb`` (H, W, 3) uint8 with the visible selected Gaussians of a scene in yellow."""
    mask: OpenedScene | None = opened.once("selection", lambda: None)
    if mask is None:
        return rgb
    weights = 0.6 * _layer(mask, replace(request, layer="colour", background=(0, 0, 0))) / 255
    return (rgb + weights * ((255, 200, 0) - rgb.astype(np.float32))).astype(np.uint8)


def truth_in_window(
    opened: OpenedScene, view: int, size: tuple[int, int], background: Tensor
) -> np.ndarray | None:
    """Return the true image of a view, fitted into a window of ``size`` px: (H, W, 4) uint8.

    Pixels outside the image are transparent.
    """
    from PIL import Image, ImageOps

    images = views_of(opened).images
    if images is None:
        return None
    pixels = to_uint8(images[view].composite(background.cpu()).numpy())
    image = Image.fromarray(pixels).convert("RGBA")
    return np.asarray(ImageOps.pad(image, size, color=(0, 0, 0, 0)))


@torch.no_grad()
def _layer(opened: OpenedScene, request: ViewRequest) -> np.ndarray:
    """Return one layer (H, W, 3) uint8; colours for the layer "error"."""
    match request.layer:
        case "depth":
            return depth_to_rgb(*depth_of(opened, request))
        case "normal":
            return normals_to_rgb(*depth_of(opened, request), request.camera)
        case "alpha":
            pixels = _rendering(opened, request).alpha[0, ..., None].expand(-1, -1, 3)
        case _:
            pixels = _rendering(opened, request).rgb[0]
    return to_uint8(pixels.clamp(0, 1).cpu().numpy())


def normals_to_rgb(depth: np.ndarray, alpha: np.ndarray, camera: Cameras) -> np.ndarray:
    """Return the surface normals (H, W, 3) uint8 of a depth image (H, W), in world axes.

    Components -1 to 1 become 0 to 255. Transparent pixels are black.
    """
    y, x = np.indices(depth.shape) + 0.5
    inverse = torch.linalg.inv(camera.intrinsics[0].double()).cpu().numpy()
    points = depth[..., None] * (np.stack([x, y, np.ones_like(x)], axis=-1) @ inverse.T)
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    normals = normals @ camera.cam_from_world[0, :3, :3].double().cpu().numpy()
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
    return to_uint8((0.5 + 0.5 * normals) * alpha[..., None])


def with_levels(opened: OpenedScene, most: int) -> OpenedScene:
    """Return a static scene with levels of detail: at most ``most`` Gaussians are rendered while it
    moves."""
    opened = opened.noted(f"at most {most:,} Gaussians are rendered while the view moves")
    opened.once("levels", lambda: LevelScene.from_scene(opened.renderable, most))
    return opened


def _rendering(opened: OpenedScene, request: ViewRequest, **options: Any) -> Rendering:
    """Return a rendering on the CPU. The last deformed scene is cached."""
    part = request.part
    scene = opened.renderable
    levels: LevelScene | None = opened.once("levels", lambda: None)
    if levels is not None and request.is_moving and part == "all" and not options:
        return levels.render(request.camera, background=request.behind(opened)).to(device="cpu")
    if part != "all":
        scene = opened.once(part, lambda: opened.scene.part(part))
    kept: dict[str, tuple[float | None, TimeStep]] = opened.once("time steps", dict)
    if part not in kept or kept[part][0] != request.time:
        kept[part] = request.time, scene.drawing_step(request.time)
    how = replace(scene.options, **options)
    behind = request.behind(opened)
    rendering = scene.render(request.camera, kept[part][1], options=how, background=behind)
    return rendering.to(device="cpu")


@torch.no_grad()
def depth_of(opened: OpenedScene, request: ViewRequest) -> tuple[np.ndarray, np.ndarray]:
    """Return expected depth (H, W) along the optical axis in world units, and alpha (H, W)."""
    rendering = _rendering(opened, request, depth="expected")
    depth = np.zeros(0) if rendering.depth is None else rendering.depth[0].numpy()
    return depth, rendering.alpha[0].numpy()
