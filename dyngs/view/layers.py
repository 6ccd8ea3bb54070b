"""Images of a scene for the viewer: colours, depth, opacity, motion, and the error against the
truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0
from dyngs.export.camera_paths import resize_cameras
from dyngs.export.images import color_map, depth_to_rgb
from dyngs.gaussians.levels import LevelScene
from dyngs.gaussians.scene import GaussianScene, GaussianTimeStep
from dyngs.human.avatar.scene import avatar_of
from dyngs.io.write import to_uint8
from dyngs.models.renderable import Rendering, TimeStep
from dyngs.runs.opened import Opened
from dyngs.view.captured_views import views_of

Layer = Literal["colour", "depth", "alpha", "motion", "filled", "error"]
Part = Literal["all", "moving", "still"]
LAYERS: tuple[Layer, ...] = get_args(Layer)
PARTS: tuple[Part, ...] = get_args(Part)

ERROR_GAIN = 4.0
"""Factor of the mean absolute error before it is coloured, as in contact sheets."""
_MOTION_TIMES = 12
_LEVELS = "levels"
_FILLED = (1.0, 0.0, 1.0)  # colour that marks what no training view of a person shows
_LINE = (255, 200, 0)
"""Colour of the line between render and truth."""


@dataclass(frozen=True)
class Shot:
    """One image to draw.

    Attributes:
        camera: one camera, of the size of the image.
        layer: what is shown; "error" needs ``view``.
        view: the view of the capture whose camera, time and truth are shown instead; None: no
            truth.
        divide: fraction of the width that shows the render; the truth is on the right of it.
        is_moving: it is one of many, and drawn in levels of detail where ``coarser`` has made them.
    """

    camera: Cameras
    time: float | None = None
    layer: Layer = "colour"
    part: Part = "all"
    view: int | None = None
    divide: float = 1.0
    is_moving: bool = False


def draw(opened: Opened, shot: Shot) -> np.ndarray:
    """Return the image (H, W, 3) uint8 of a shot."""
    camera = shot.camera
    time = shot.time
    if shot.view is not None:
        camera = resize_cameras(views_of(opened).cameras[shot.view], camera.width, camera.height)
        time = views_of(opened).times[shot.view]
    with torch.no_grad():
        rgb = _layer(opened, shot, camera, time)
        if shot.view is None:
            return rgb
        truth = truth_in_window(opened, shot.view, (camera.width, camera.height))
    if truth is None:
        return rgb
    if shot.layer == "error":
        return _error(rgb, truth)
    beside = np.isnan(truth)
    rgb = np.where(beside, rgb // 2, rgb)  # there is no truth: darker
    return _divided(
        rgb, np.where(beside, rgb, to_uint8(np.nan_to_num(truth))).astype(np.uint8), shot.divide
    )


def truth_in_window(opened: Opened, view: int, size: tuple[int, int]) -> np.ndarray | None:
    """Return the true image of a view as large as it fits into a window of ``size``, px: (H, W, 3),
    NaN next to it."""
    images = views_of(opened).images
    if images is None:
        return None
    image = images[view].composite(opened.background.cpu())
    high, wide = image.shape[:2]
    width, height = size
    scale = min(width / wide, height / high)
    own = max(1, round(scale * high)), max(1, round(scale * wide))
    shown = functional.interpolate(
        image.permute(2, 0, 1)[None], own, mode="bilinear", align_corners=False, antialias=scale < 1
    )
    window = np.full((height, width, 3), np.nan, np.float32)
    top = (height - own[0]) // 2
    left = (width - own[1]) // 2
    window[top : top + own[0], left : left + own[1]] = shown[0].permute(1, 2, 0).clamp(0, 1).numpy()
    return window


def motion_colours(opened: Opened) -> Tensor:
    """Return (N, 3) colours of how far each Gaussian moves over all times: dark blue is not at all,
    red is far.

    Red begins where 99% of those that move are left behind. On the CPU.
    """
    return opened.once("motion", lambda: _motion_colours(opened.scene))


def _layer(opened: Opened, shot: Shot, camera: Cameras, time: float | None) -> np.ndarray:
    """Return one layer (H, W, 3) uint8; for the error it is the colours."""
    match shot.layer:
        case "colour" | "error":
            return to_uint8(
                _coarser_or_whole(opened, shot, camera, time).rgb[0].clamp(0, 1).numpy()
            )
        case "alpha":
            alpha = to_uint8(
                _coarser_or_whole(opened, shot, camera, time).alpha[0].clamp(0, 1).numpy()
            )
            return np.repeat(alpha[..., None], 3, axis=2)
        case "depth":
            return depth_to_rgb(*depth_of(opened, shot.part, camera, time))
        case "motion":
            return _motion(opened, shot.part, camera, time)
        case "filled":
            return _filled(opened, camera, time)


def coarser(opened: Opened, most: int) -> Opened:
    """Return a still scene of which at most ``most`` Gaussians are drawn while anything moves.
    Raises DyngsError."""
    opened = opened.noted(f"while anything moves, at most {most:,} Gaussians are drawn")
    opened.once(_LEVELS, lambda: [LevelScene.of(opened.renderable, most)])
    return opened


def _coarser_or_whole(opened: Opened, shot: Shot, camera: Cameras, time: float | None) -> Rendering:
    may_be_coarser = shot.is_moving and shot.part == "all" and shot.layer != "error"
    levels: list[LevelScene] = opened.once(_LEVELS, list) if may_be_coarser else []
    return (
        levels[0].render(camera).to(device="cpu")
        if levels
        else _rendering(opened, shot.part, camera, time)
    )


def _rendering(
    opened: Opened, part: Part, camera: Cameras, time: float | None, with_depth: bool = False
) -> Rendering:
    """Return a rendering, on the CPU; the scene at the last time is kept."""
    scene = (
        opened.renderable if part == "all" else opened.once(part, lambda: opened.scene.part(part))
    )
    kept: dict[str, tuple[float | None, TimeStep]] = opened.once("time steps", dict)
    if part not in kept or kept[part][0] != time:
        kept[part] = time, scene.time_step(time)
    options = replace(scene.options, depth="expected") if with_depth else None
    return scene.render(camera, kept[part][1], options=options).to(device="cpu")


def depth_of(
    opened: Opened, part: Part, camera: Cameras, time: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected depth (H, W), world units along the axis of the camera, and the opacity
    (H, W) there."""
    with torch.no_grad():
        made = _rendering(opened, part, camera, time, with_depth=True)
    return np.zeros(0) if made.depth is None else made.depth[0].numpy(), made.alpha[0].numpy()


def _motion(opened: Opened, part: Part, camera: Cameras, time: float | None) -> np.ndarray:
    """Return the image of the motion (H, W, 3) uint8, on black."""
    scene = opened.scene.unmasked()
    colours = motion_colours(opened)
    gaussians = scene.at(time)
    coloured = gaussians.replace(sh=((colours - 0.5) / SH_C0)[:, None].to(gaussians.means))
    if part != "all":
        moves = torch.zeros(len(scene), dtype=torch.bool, device=gaussians.means.device)
        if not scene.is_static:
            moves[scene.rows] = True
        coloured = coloured.select(moves if part == "moving" else ~moves)
    plain = replace(scene, colour=None, background=None)
    made = plain.render(
        camera, GaussianTimeStep(coloured, time), options=replace(opened.scene.options, sh_degree=0)
    )
    return to_uint8(made.rgb[0].clamp(0, 1).cpu().numpy())


def shows_filled(opened: Opened) -> bool:
    """Return whether it is known which surface of a person no training view shows."""
    person = avatar_of(opened.renderable)
    return person is not None and person.seen is not None and person.colour is None


def _filled(opened: Opened, camera: Cameras, time: float | None) -> np.ndarray:
    """Return the image (H, W, 3) uint8 with marked what is filled in; the plain one where that is
    not known."""
    scene = opened.scene
    person = avatar_of(opened.renderable)
    if person is None or person.seen is None or not shows_filled(opened):
        return to_uint8(_rendering(opened, "all", camera, time).rgb[0].clamp(0, 1).numpy())
    now = scene.time_step(time)
    mark = (now.gaussians.sh.new_tensor(_FILLED) - 0.5) / SH_C0
    sh = now.gaussians.sh * person.seen[:, None, None]
    sh[:, 0] += (1 - person.seen)[:, None] * mark
    marked = replace(now, gaussians=now.gaussians.replace(sh=sh))
    return to_uint8(scene.render(camera, marked).to(device="cpu").rgb[0].clamp(0, 1).numpy())


def _motion_colours(scene: GaussianScene) -> Tensor:
    far = torch.zeros(len(scene), device=scene.gaussians.means.device)
    if not scene.is_static:
        whole = scene.unmasked()
        times = np.linspace(0, 1, _MOTION_TIMES).tolist()
        low = high = whole.at(times[0]).means
        for time in times[1:]:
            means = whole.at(time).means
            low = torch.minimum(low, means)
            high = torch.maximum(high, means)
        far = (high - low).norm(dim=1)
        moves = far[scene.rows]
        far = far / (torch.quantile(moves[:: max(1, len(moves) // 100_000)], 0.99).clamp_min(1e-12))
    coloured = color_map(far.clamp(0, 1).cpu().numpy()[None], "turbo")[0]
    return torch.from_numpy(coloured.astype(np.float32) / 255.0)


def _error(rgb: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the mean absolute error as colours (H, W, 3) uint8, black next to the true image."""
    difference = np.abs(rgb.astype(np.float32) / 255.0 - truth).mean(axis=2)
    return color_map(np.nan_to_num(ERROR_GAIN * difference), "magma")


def _divided(left: np.ndarray, right: np.ndarray, divide: float) -> np.ndarray:
    """Return ``left`` up to the share ``divide`` of the width, a line, and ``right`` beyond it."""
    width = left.shape[1]
    column = round(min(max(divide, 0.0), 1.0) * width)
    made = np.concatenate([left[:, :column], right[:, column:]], axis=1)
    if 0 < column < width:
        made[:, max(column - 1, 0) : column + 1] = _LINE
    return made
