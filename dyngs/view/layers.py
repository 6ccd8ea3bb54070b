"""Images of a scene for the viewer: colours, depth, opacity, and the error against the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.export.camera_paths import resize_cameras
from dyngs.export.images import color_map, depth_to_rgb
from dyngs.gaussians.levels import LevelScene
from dyngs.io.write import to_uint8
from dyngs.models.renderable import Rendering, TimeStep
from dyngs.runs.opened import OpenedScene
from dyngs.view.views import views_of

Layer = Literal["colour", "depth", "alpha", "error"]
Part = Literal["all", "moving", "still"]
LAYERS: tuple[Layer, ...] = get_args(Layer)
PARTS: tuple[Part, ...] = get_args(Part)


@dataclass(frozen=True)
class ViewRequest:
    """One image to draw.

    Attributes:
        camera: one camera, of the size of the image.
        layer: what is shown; "error" needs ``view``.
        view: the view of the capture whose camera, time and truth are shown instead; None: no
            truth.
        divide: fraction of the width that shows the render; the truth is on the right of it.
        is_moving: it is one of many, drawn in levels of detail where ``coarser`` has made them.
    """

    camera: Cameras
    time: float | None = None
    layer: Layer = "colour"
    part: Part = "all"
    view: int | None = None
    divide: float = 1.0
    is_moving: bool = False


def draw(opened: OpenedScene, request: ViewRequest) -> np.ndarray:
    """Return the image (H, W, 3) uint8 of a shot."""
    if request.view is None:
        return _layer(opened, request)
    views = views_of(opened)
    size = request.camera.width, request.camera.height
    camera = resize_cameras(views.cameras[request.view], *size)
    rgb = _layer(opened, replace(request, camera=camera, time=views.views[request.view].time))
    truth = truth_in_window(opened, request.view, size)
    if truth is None:
        return rgb
    beside = truth[..., 3:] == 0
    truth = truth[..., :3]
    if request.layer == "error":
        difference = np.abs(rgb.astype(np.float32) - truth) * ~beside / 255.0
        return color_map(4.0 * difference.mean(axis=2), "magma")
    rgb = np.where(beside, rgb // 2, rgb)  # there is no truth: darker
    made = np.where(beside, rgb, truth)
    column = round(min(max(request.divide, 0.0), 1.0) * size[0])
    made[:, :column] = rgb[:, :column]
    if 0 < column < size[0]:
        made[:, max(column - 1, 0) : column + 1] = (255, 200, 0)
    return made


def truth_in_window(opened: OpenedScene, view: int, size: tuple[int, int]) -> np.ndarray | None:
    """Return the true image of a view as large as it fits into a window of ``size``, px: (H, W, 4)
    uint8, transparent next to it."""
    from PIL import Image, ImageOps

    images = views_of(opened).images
    if images is None:
        return None
    pixels = to_uint8(images[view].composite(opened.background.cpu()).numpy())
    image = Image.fromarray(pixels).convert("RGBA")
    return np.asarray(ImageOps.pad(image, size, color=(0, 0, 0, 0)))


@torch.no_grad()
def _layer(opened: OpenedScene, request: ViewRequest) -> np.ndarray:
    """Return one layer (H, W, 3) uint8; for the error it is the colours."""
    match request.layer:
        case "depth":
            return depth_to_rgb(*depth_of(opened, request))
        case "alpha":
            pixels = _rendering(opened, request).alpha[0, ..., None].expand(-1, -1, 3)
        case _:
            pixels = _rendering(opened, request).rgb[0]
    return to_uint8(pixels.clamp(0, 1).cpu().numpy())


def with_levels(opened: OpenedScene, most: int) -> OpenedScene:
    """Return a still scene of which at most ``most`` Gaussians are drawn while anything moves.
    Raises DyngsError."""
    opened = opened.noted(f"while anything moves, at most {most:,} Gaussians are drawn")
    opened.once("levels", lambda: LevelScene.from_scene(opened.renderable, most))
    return opened


def _rendering(opened: OpenedScene, request: ViewRequest, **options: Any) -> Rendering:
    """Return a rendering, on the CPU; the scene at the last time is kept."""
    part = request.part
    scene = opened.renderable
    levels: LevelScene | None = opened.once("levels", lambda: None)
    if levels is not None and request.is_moving and part == "all" and not options:
        return levels.render(request.camera).to(device="cpu")
    if part != "all":
        scene = opened.once(part, lambda: opened.scene.part(part))
    kept: dict[str, tuple[float | None, TimeStep]] = opened.once("time steps", dict)
    if part not in kept or kept[part][0] != request.time:
        kept[part] = request.time, scene.time_step(request.time)
    how = replace(scene.options, **options)
    return scene.render(request.camera, kept[part][1], options=how).to(device="cpu")


@torch.no_grad()
def depth_of(opened: OpenedScene, request: ViewRequest) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected depth (H, W), world units along the axis of the camera, and the opacity
    (H, W) there."""
    made = _rendering(opened, request, depth="expected")
    return np.zeros(0) if made.depth is None else made.depth[0].numpy(), made.alpha[0].numpy()
