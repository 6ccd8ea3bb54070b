"""Priors of a capture (depth maps, optical flow, tracks, motion masks) and their losses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.config import Config
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, View, all_views
from dyngs.data.images.lens import undistort_points
from dyngs.data.loader import Image
from dyngs.data.tracks import read_tracks
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.gaussians.scene import GaussianScene
from dyngs.models.model import Loss, LossInput
from dyngs.models.views import training_cameras
from dyngs.training.corrections.cells import project_points

SOFT_PX = 0.5  # Constant of the Charbonnier loss, px: smaller errors are penalised quadratically
SOLID = 0.5  # Rendered alpha above which depth and displacement are compared
DEPTH_WEIGHT = 0.1  # Weight of the depth term; flow and tracks have weight 1
MIN_PIXELS = 16  # Fewest pixels with which a depth map is aligned
MIN_POINTS = 4  # Fewest points that two images must share to compare their tracks
NEAREST = 8  # Tracks are compared with one of this many images nearest in time
_TINY = 1e-6


@dataclass(frozen=True)
class TimedCamera:
    """Camera and time of another image of the same scene."""

    cameras: Cameras
    time: float


@dataclass(frozen=True)
class PointTracks:
    """2D point tracks in the V training images."""

    xy: Tensor  # (V, P, 2) in px of the full-size training images
    visible: Tensor  # (V, P) bool; False for views without tracks
    cameras: Sequence[TimedCamera]  # V of them

    def pair(
        self, index: int, may_use: Callable[[float], bool], generator: torch.Generator
    ) -> tuple[TimedCamera, Tensor, Tensor] | None:
        """Draw another view among the nearest in time, with its camera and the points visible in
        both.

        Returns:
            the camera of the other view, and the points (P', 2) in this and in the other view. None
                without such a view.
        """
        now = self.cameras[index].time
        shared = (self.visible & self.visible[index]).sum(1)
        others = [
            i
            for i, other in enumerate(self.cameras)
            if other.time != now and int(shared[i]) >= MIN_POINTS and may_use(other.time)
        ]
        if not others:
            return None
        nearest = sorted(others, key=lambda i: abs(self.cameras[i].time - now))[:NEAREST]
        other = nearest[int(torch.randint(len(nearest), (), generator=generator, device="cpu"))]
        both = self.visible[index] & self.visible[other]
        return self.cameras[other], self.xy[index][both], self.xy[other][both]


def load_priors(
    config: Config, capture: Capture, views: Sequence[View], *, moves: bool
) -> PriorLosses:
    """Return the losses of the priors in ``train.priors`` that the training ``views`` provide.

    Args:
        moves: whether the model is dynamic. Motion priors are ignored otherwise.
    """
    wanted = config.train.priors if moves else {"depth"}.intersection(config.train.priors)
    depth = "depth" in wanted and any(view.depth_path for view in views)
    masks = "motion_masks" in wanted and any(view.motion_mask_path for view in views)
    flow_to: dict[int, TimedCamera] = {}
    if "flow" in wanted:
        named = {view.name: view for view in all_views(capture.splits)}
        flow_to = {
            i: _timed_camera(named[view.flow_to], config)
            for i, view in enumerate(views)
            if view.flow_path is not None and view.flow_to in named and view.time is not None
        }
    tracks = None
    if "tracks" in wanted and capture.tracks_path is not None:
        tracks = _point_tracks(config, capture.tracks_path, views)
    found = {"depth maps": depth, "optical flow": flow_to, "tracks": tracks, "motion masks": masks}
    names = ", ".join(name for name, x in found.items() if x)
    return PriorLosses(depth, flow_to, tracks, masks, names and f"using priors: {names}")


def _timed_camera(view: View, config: Config) -> TimedCamera:
    return TimedCamera(training_cameras([view], config.data)[0], view.time or 0.0)


def _point_tracks(config: Config, path: Path, views: Sequence[View]) -> PointTracks:
    """Return undistorted tracks in px of training images. Points that cannot be undistorted are not
    visible.

    Raises DyngsError if the tracks belong to none of the views.
    """
    tracks = read_tracks(path)
    rows = tracks.rows_of(views)
    if not rows:
        raise DyngsError(
            f"{path}: 'names' holds no training view, such as {views[0].name!r}; write the "
            "file_path of each frame"
        )
    xy = torch.zeros(len(views), tracks.visible.shape[1], 2, device="cpu")
    visible = torch.zeros(xy.shape[:2], dtype=torch.bool, device="cpu")
    cameras = [_timed_camera(view, config) for view in views]
    for i, view in enumerate(views):
        row = rows.get(view.name)
        if row is None or view.time is None:
            continue
        stored = torch.from_numpy(np.ascontiguousarray(tracks.xy[row]))
        own = cameras[i].cameras
        places = undistort_points(view.lens, view.intrinsics, stored) * _scale(view, own)
        good = places.isfinite().all(1) & (places >= 0).all(1)
        good &= (places <= places.new_tensor([own.width, own.height])).all(1)
        xy[i] = torch.where(good[:, None], places, 0.0)
        visible[i] = torch.from_numpy(np.ascontiguousarray(tracks.visible[row])) & good
    return PointTracks(xy, visible, cameras)


def _scale(size: View | Cameras, wanted: Cameras) -> Tensor:
    """Return the (2,) factors from px of one image size to those of another."""
    factors = [wanted.width / size.width, wanted.height / size.height]
    return wanted.intrinsics.new_tensor(factors)


@dataclass(frozen=True)
class PriorLosses(Loss):
    """Losses of depth maps, optical flow and tracks; motion masks are used by the image loader."""

    depth: bool = False  # depth maps are used
    # camera and time that the flow of each training view points to; empty without flow
    flow_to: Mapping[int, TimedCamera] = field(default_factory=dict)
    tracks: PointTracks | None = None
    masks: bool = False  # motion masks are used
    message: str = ""

    def needs_depth(self, image: Image) -> bool:
        return self.depth and image.depth is not None

    def __call__(self, look: LossInput) -> dict[str, Tensor]:
        found: dict[str, Tensor | None] = {}
        image = look.image
        rendering = look.drawn.rendering
        scene = look.model.scene
        if self.depth and image.depth is not None and rendering.depth is not None:
            error = depth_error(rendering.depth[0], rendering.alpha[0], image.depth, image.mask)
            found["depth"] = None if error is None else DEPTH_WEIGHT * error
        if isinstance(scene, GaussianScene) and not scene.is_static and image.time is not None:
            found |= self._motion(scene, look)
        return {name: x for name, x in found.items() if x is not None}

    def _motion(self, scene: GaussianScene, look: LossInput) -> dict[str, Tensor | None]:
        image = look.image
        here = image.cameras
        first, last = look.model.window(look.step)

        def may_use(time: float) -> bool:
            return first <= time <= last

        canonical = scene.with_gaussians(scene.gaussians.detach())
        options = replace(scene.options, nonfinite="trust")

        def drawn(other: TimedCamera) -> Tensor:
            start, end = (canonical.time_step(t).gaussians for t in (image.time, other.time))
            there = other.cameras.resized(here.width, here.height)
            return render_displacements(start, end, here, there, options)

        found: dict[str, Tensor | None] = {}
        target = self.flow_to.get(look.index)
        if target is not None and image.flow is not None and may_use(target.time):
            flow = image.flow
            if image.mask is not None:
                flow = torch.where(image.mask[..., None] > 0, flow, torch.nan)
            found["flow"] = motion_error(drawn(target), flow, max(here.width, here.height))
        pair = self.tracks and self.tracks.pair(look.index, may_use, look.generator)
        if pair and self.tracks is not None:
            other, start, end = pair
            start = start * _scale(self.tracks.cameras[look.index].cameras, here)
            end = end * _scale(other.cameras, here)
            found["tracks"] = track_error(drawn(other), start, end)
        return found


def depth_error(
    drawn: Tensor, alpha: Tensor, given: Tensor, mask: Tensor | None = None
) -> Tensor | None:
    """Return the mean relative error of the rendered inverse depth, or None with too few pixels.

    The map is aligned to the rendered inverse depth by scale and shift, without gradients. Sensor
    maps are known up to scale, and maps of monocular networks are affine in inverse depth. Errors
    are divided by the median of the rendered values.
    """
    counts = (given > 0) & (drawn > 0) & (alpha.detach() > SOLID)
    if mask is not None:
        counts = counts & (mask > 0)
    if int(counts.sum()) < MIN_PIXELS:
        return None
    inverse = 1 / drawn[counts].clamp_min(_TINY)
    target = align_scale_shift(1 / given[counts].clamp_min(_TINY), inverse.detach())
    if target is None:
        return None
    return (inverse - target).abs().mean() / inverse.detach().median().clamp_min(_TINY)


def align_scale_shift(given: Tensor, wanted: Tensor) -> Tensor | None:
    """Return ``a given + b`` closest to ``wanted``, both (P,), or None for a negative ``a``.

    Least absolute deviations by iteratively reweighted least squares, robust to 10 % of outliers.
    """
    weight = torch.ones_like(given)
    a = b = given.new_zeros(())
    for _ in range(4):
        total = weight.sum()
        mean_x = (weight * given).sum() / total
        mean_y = (weight * wanted).sum() / total
        x = given - mean_x
        a = (weight * x * (wanted - mean_y)).sum() / (weight * x.square()).sum().clamp_min(_TINY**2)
        b = mean_y - a * mean_x
        error = (a * given + b - wanted).abs()
        weight = 1 / error.clamp_min(0.1 * float(error.median()) + _TINY)
    return a * given + b if bool(a > 0) else None


def render_displacements(
    start: Gaussians, end: Gaussians, here: Cameras, there: Cameras, options: RenderOptions
) -> Tensor:
    """Render the mean 2D displacement of Gaussians between two times.

    Only the means of ``start`` and ``end`` receive gradients, not the coverage of pixels.

    Returns:
        (H, W, 3): displacement x and y in px, and the sum of blending weights.
    """
    from_px, from_z = project_points(here, start.means)
    to_px, to_z = project_points(there, end.means)
    seen = ((from_z > options.near) & (to_z > options.near))[:, None]
    limit = float(here.width + here.height)
    moved = torch.where(seen, to_px - from_px, 0.0).clamp(-limit, limit)
    carried = torch.cat([moved, seen.to(moved)], dim=1)[None]
    drawn = render(start.detach(), here, options, shader=lambda *_: carried).rgb[0]
    total = drawn[..., 2:]
    return torch.cat([drawn[..., :2] / total.detach().clamp_min(0.1), total], dim=-1)


def motion_error(drawn: Tensor, wanted: Tensor, size: int) -> Tensor | None:
    """Return the mean Charbonnier error of displacements, relative to the image size.

    Args:
        drawn: (..., 3) as returned by ``render_displacements``.
        wanted: (..., 2) true displacement in px. NaN is ignored.
        size: longer side of the image in px.

    Returns:
        a scalar, or None if no pixel can be compared.
    """
    counts = wanted.isfinite().all(-1) & (drawn[..., 2].detach() > SOLID)
    if not bool(counts.any()):
        return None
    errors = (drawn[..., :2][counts] - wanted[counts]).square().sum(-1)
    return ((errors + SOFT_PX**2).sqrt() - SOFT_PX).mean() / size


def track_error(drawn: Tensor, start: Tensor, end: Tensor) -> Tensor | None:
    """Return ``motion_error`` at points ``start`` (P, 2) px that moved to ``end`` (P, 2) px."""
    height, width = drawn.shape[:2]
    grid = (2 * start / start.new_tensor([width, height]) - 1)[None, None]
    sampled = torch.nn.functional.grid_sample(
        drawn.permute(2, 0, 1)[None], grid, align_corners=False
    )[0, :, 0].T
    return motion_error(sampled, end - start, max(height, width))
