"""Quality and speed of variants, measured by rendering them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean, median

import numpy as np

from dyngs.config import SceneModel
from dyngs.conventions import RasterizeMode
from dyngs.data.loader import Image
from dyngs.errors import DyngsError
from dyngs.evaluate.drawing import Drawing, seconds_in_turn
from dyngs.gaussians.rendering import RenderOptions
from dyngs.gaussians.scene import render_options
from dyngs.metrics import Lpips, psnr, ssim
from dyngs.tradeoff.measurements import Quartiles, Speed
from dyngs.tradeoff.variants import Variant


@dataclass(frozen=True)
class Quality:
    """Means over images; LPIPS is None where it cannot be computed."""

    psnr: float
    ssim: float
    lpips: float | None


def with_render_settings(variant: Variant, model: SceneModel) -> SceneModel:
    """Return the ``model`` section of a run with the render settings of a variant."""
    changes = {"alpha_min": variant.alpha_min, "transmittance_min": variant.transmittance_min}
    changes |= {"rasterize_mode": None if variant.mode is None else RasterizeMode(variant.mode)}
    return model.model_copy(update={name: value for name, value in changes.items() if value is not None})


def render_options_of(variant: Variant, model: SceneModel) -> RenderOptions:
    """Return the render options of a variant of a run with ``model``."""
    return render_options(with_render_settings(variant, model))


def measure_quality(drawing: Drawing, images: Iterable[Image], lpips: Lpips) -> Quality:
    """Return mean metrics over images, each rendered at its own time."""
    psnrs, ssims, distances = [], [], []
    for image in images:
        rendered, truth = drawing.image(image.cameras, image.time), image.composite(drawing.background)
        if not bool(rendered.isfinite().all()):
            raise DyngsError(f"view {image.name!r}: the render holds NaN or Inf")
        psnrs.append(psnr(rendered, truth, image.mask))
        ssims.append(ssim(rendered, truth, image.mask))
        distances.append(lpips(rendered, truth, image.mask).value)
    known = [x for x in distances if x is not None]
    return Quality(fmean(psnrs), fmean(ssims), fmean(known) if len(known) == len(distances) else None)


def time_interleaved(drawings: Sequence[Drawing], images: Sequence[Image], rounds: int) -> list[Speed]:
    """Return the speed of each drawing, relative to the first one; arguments as for ``seconds_in_turn``."""
    seconds = seconds_in_turn(drawings, images, rounds)
    return [Speed(ms=quartiles(1e3 * own), gain=quartiles(seconds[0] / own)) for own in seconds]


def quartiles(values: np.ndarray) -> Quartiles:
    low, high = np.percentile(values, [25, 75])
    return Quartiles(float(median(values)), float(low), float(high))
