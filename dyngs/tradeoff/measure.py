"""Quality and speed of variants, measured by rendering them."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean, median

import numpy as np
import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.config import SceneModel
from dyngs.conventions import RasterizeMode
from dyngs.data.loader import Image
from dyngs.errors import DyngsError
from dyngs.gaussians.rendering import RenderOptions
from dyngs.gaussians.scene import Scene, render_options
from dyngs.metrics import Lpips, psnr, ssim
from dyngs.ops.device import finish
from dyngs.tradeoff.measurements import Quartiles, Speed
from dyngs.tradeoff.variants import Variant


@dataclass(frozen=True)
class VariantRenderer:
    """Renders a variant.

    Attributes:
        scene: its scene.
        options: how to render it.
        background: (3,) colour.
        scale: width and height rendered, relative to those returned.
    """

    scene: Scene
    options: RenderOptions
    background: Tensor
    scale: float = 1.0

    @torch.no_grad()
    def image(self, cameras: Cameras, time: float | None) -> Tensor:
        """Return (H, W, 3), seen by one camera at ``time``; upscaled bilinearly if ``scale`` < 1."""
        small = scaled_cameras(cameras, self.scale)
        rgb = self.scene.render(small, time, options=self.options, background=self.background).rgb[0]
        size = (cameras.height, cameras.width)
        if rgb.shape[:2] == size:
            return rgb
        return torch.nn.functional.interpolate(rgb.permute(2, 0, 1)[None], size=size, mode="bilinear")[0].permute(
            1, 2, 0
        )


@dataclass(frozen=True)
class Quality:
    """Means over images; LPIPS is None where it cannot be computed."""

    psnr: float
    ssim: float
    lpips: float | None


def with_render_settings(variant: Variant, model: SceneModel) -> SceneModel:
    """Return the ``model`` section of a run with the render settings of a variant."""
    mode = None if variant.mode is None else RasterizeMode(variant.mode)
    changes = {
        "rasterize_mode": mode,
        "alpha_min": variant.alpha_min,
        "transmittance_min": variant.transmittance_min,
    }
    return model.model_copy(update={name: value for name, value in changes.items() if value is not None})


def render_options_of(variant: Variant, model: SceneModel) -> RenderOptions:
    """Return the render options of a variant of a run with ``model``."""
    return render_options(with_render_settings(variant, model))


def scaled_cameras(cameras: Cameras, scale: float) -> Cameras:
    """Return the cameras with width and height times ``scale``, rounded to whole pixels."""
    if scale == 1:
        return cameras
    width, height = (max(1, round(scale * side)) for side in (cameras.width, cameras.height))
    factors = cameras.intrinsics.new_tensor([width / cameras.width, height / cameras.height, 1.0])
    return Cameras(cameras.cam_from_world, factors[:, None] * cameras.intrinsics, width, height)


def measure_quality(renderer: VariantRenderer, images: Iterable[Image], lpips: Lpips) -> Quality:
    """Return mean metrics over images, each rendered at its own time.

    Raises:
        DyngsError: a render holds NaN or Inf.
    """
    psnrs, ssims, distances = [], [], []
    for image in images:
        rendered, truth = renderer.image(image.cameras, image.time), image.composite(renderer.background)
        if not bool(rendered.isfinite().all()):
            raise DyngsError(f"view {image.name!r}: the render holds NaN or Inf")
        psnrs.append(psnr(rendered, truth, image.mask))
        ssims.append(ssim(rendered, truth, image.mask))
        distances.append(lpips(rendered, truth, image.mask).value)
    known = [x for x in distances if x is not None]
    return Quality(fmean(psnrs), fmean(ssims), fmean(known) if len(known) == len(distances) else None)


def time_interleaved(renderers: Sequence[VariantRenderer], images: Sequence[Image], rounds: int) -> list[Speed]:
    """Return the speed of each renderer, relative to the first one.

    All render each image in turn, starting with another one each time, so that other load on the machine affects all
    alike.

    Args:
        renderers: at least one.
        images: their cameras and times are rendered.
        rounds: renders of each image.
    """
    seconds = np.zeros((len(renderers), rounds * len(images)))
    for renderer in renderers:
        renderer.image(images[0].cameras, images[0].time)  # warm-up
    for column in range(seconds.shape[1]):
        image = images[column % len(images)]
        for turn in range(len(renderers)):
            row = (column + turn) % len(renderers)
            start = time.perf_counter()
            finish(renderers[row].image(image.cameras, image.time).device)
            seconds[row, column] = time.perf_counter() - start
    return [Speed(ms=quartiles(1e3 * own), gain=quartiles(seconds[0] / own)) for own in seconds]


def quartiles(values: np.ndarray) -> Quartiles:
    """Return median and quartiles."""
    low, high = np.percentile(values, [25, 75])
    return Quartiles(float(median(values)), float(low), float(high))
