"""How good, how fast and how large what a variant draws is."""

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
from dyngs.data.loader import Picture
from dyngs.errors import DyngsError
from dyngs.evaluate.report import render_options
from dyngs.metrics import Lpips, psnr, ssim
from dyngs.rendering import RenderOptions
from dyngs.scene import Scene
from dyngs.tradeoff.measurements import Quartiles, Speed
from dyngs.tradeoff.variants import Variant


@dataclass(frozen=True)
class VariantRenderer:
    """Draws a variant.

    Attributes:
        scene: its Gaussians.
        options: how they are drawn.
        background: (3,) colour.
        scale: sides of what is drawn over those of what comes out.
    """

    scene: Scene
    options: RenderOptions
    background: Tensor
    scale: float = 1.0

    @torch.no_grad()
    def picture(self, cameras: Cameras, time: float | None) -> Tensor:
        """(H, W, 3) what the one camera sees at ``time``; drawn smaller and enlarged bilinearly where ``scale`` < 1."""
        smaller = scaled_cameras(cameras, self.scale)
        seen = self.scene.render(smaller, time, options=self.options, background=self.background).rgb[0]
        if seen.shape[:2] == (cameras.height, cameras.width):
            return seen
        size = (cameras.height, cameras.width)
        return torch.nn.functional.interpolate(seen.permute(2, 0, 1)[None], size=size, mode="bilinear")[0].permute(
            1, 2, 0
        )


@dataclass(frozen=True)
class Quality:
    """Means over pictures; LPIPS is None where it cannot be had."""

    psnr: float
    ssim: float
    lpips: float | None


def with_render_settings(variant: Variant, model: SceneModel) -> SceneModel:
    """The ``model`` of a run with how a variant of it is drawn."""
    mode = None if variant.mode is None else RasterizeMode(variant.mode)
    changes = {
        "rasterize_mode": mode,
        "alpha_min": variant.alpha_min,
        "transmittance_min": variant.transmittance_min,
    }
    return model.model_copy(update={name: value for name, value in changes.items() if value is not None})


def render_options_of(variant: Variant, model: SceneModel) -> RenderOptions:
    """How a variant is drawn that changes a run of ``model``."""
    return render_options(with_render_settings(variant, model))


def scaled_cameras(cameras: Cameras, scale: float) -> Cameras:
    """The same cameras with pictures whose sides are ``scale`` times as long, rounded to whole pixels."""
    if scale == 1:
        return cameras
    width, height = (max(1, round(scale * side)) for side in (cameras.width, cameras.height))
    factors = cameras.intrinsics.new_tensor([width / cameras.width, height / cameras.height, 1.0])
    return Cameras(cameras.cam_from_world, factors[:, None] * cameras.intrinsics, width, height)


def measure_quality(drawer: VariantRenderer, pictures: Iterable[Picture], lpips: Lpips) -> Quality:
    """Means over the pictures, each at its own time.

    Raises:
        DyngsError: a picture that holds NaN or Inf.
    """
    psnrs, ssims, distances = [], [], []
    for picture in pictures:
        drawn, truth = drawer.picture(picture.cameras, picture.time), picture.composite(drawer.background)
        if not bool(drawn.isfinite().all()):
            raise DyngsError(f"view {picture.name!r}: the render holds NaN or Inf")
        psnrs.append(psnr(drawn, truth, picture.mask))
        ssims.append(ssim(drawn, truth, picture.mask))
        distances.append(lpips(drawn, truth, picture.mask).value)
    known = [x for x in distances if x is not None]
    return Quality(fmean(psnrs), fmean(ssims), fmean(known) if len(known) == len(distances) else None)


def time_interleaved(drawers: Sequence[VariantRenderer], pictures: Sequence[Picture], rounds: int) -> list[Speed]:
    """How fast each is, the first being the run itself: all draw each picture in turn, so that what else the machine
    does hits all alike, and another one begins each time.

    Args:
        drawers: at least one.
        pictures: whose cameras and times are drawn.
        rounds: how often.
    """
    seconds = np.zeros((len(drawers), rounds * len(pictures)))
    for drawer in drawers:
        drawer.picture(pictures[0].cameras, pictures[0].time)  # the warm-up
    for column in range(seconds.shape[1]):
        picture = pictures[column % len(pictures)]
        for turn in range(len(drawers)):
            row = (column + turn) % len(drawers)
            start = time.perf_counter()
            drawers[row].picture(picture.cameras, picture.time)
            seconds[row, column] = time.perf_counter() - start
    return [Speed(ms=quartiles(1e3 * own), gain=quartiles(seconds[0] / own)) for own in seconds]


def quartiles(values: np.ndarray) -> Quartiles:
    """Median and quartiles."""
    low, high = np.percentile(values, [25, 75])
    return Quartiles(float(median(values)), float(low), float(high))
