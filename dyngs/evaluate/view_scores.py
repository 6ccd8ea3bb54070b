"""Scores of single views, and their means.

Everything is measured on one view at a time: the render against the truth, and how long it took to draw.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from dyngs.data.loader import Image
from dyngs.errors import DyngsError
from dyngs.evaluate.half_fit import right_half_scores
from dyngs.evaluate.people import person_scores
from dyngs.evaluate.regions import Regions, RegionScores
from dyngs.human.avatar.scene import avatar_of
from dyngs.metrics import Lpips, flip, psnr, ssim
from dyngs.models.renderable import DrawOptions, Renderable, Rendering
from dyngs.ops.device import finish


@dataclass(frozen=True)
class ViewScore:
    """Metrics of one view; None where a metric cannot be had (``EvalReport.reasons`` says why).

    ``render_seconds`` holds ``deform_seconds``; ``time`` is None for a still capture. Of people, ``psnr_person``
    and ``ssim_person`` are those inside the person's box, and ``psnr_black``, ``ssim_black`` and ``lpips_black`` those
    of the whole image on black.
    """

    name: str
    width: int
    height: int
    psnr: float
    ssim: float
    flip: float | None
    lpips: float | None
    render_seconds: float
    deform_seconds: float
    time: float | None = None
    psnr_person: float | None = None
    ssim_person: float | None = None
    psnr_foreground: float | None = None
    psnr_moving: float | None = None
    psnr_static: float | None = None
    psnr_right: float | None = None
    psnr_right_fitted: float | None = None
    psnr_black: float | None = None
    ssim_black: float | None = None
    lpips_black: float | None = None


@dataclass(frozen=True)
class PoseScores:
    """Means over views of a person in poses that were fitted to these views themselves; names as in ``ViewScore``.

    Attributes:
        updates: mean number of updates that the pose of a moment took.
        per_view: the single views.
    """

    psnr: float
    ssim: float
    lpips: float | None
    psnr_person: float | None
    ssim_person: float | None
    psnr_black: float | None
    ssim_black: float | None
    lpips_black: float | None
    updates: float
    per_view: tuple[ViewScore, ...]


def score_views(
    scene: Renderable,
    images: Iterable[Image],
    options: DrawOptions,
    background: Tensor,
    lpips: Lpips,
    regions: Regions | None = None,
) -> tuple[list[ViewScore], dict[str, str]]:
    """Return scores of the Gaussians against images, and the reasons for metrics that are None.

    Args:
        scene: what to draw, at the time of each image; on the device of all else.
        images: truth and camera of each view, drawn one at a time.
        options: as in training, without depth.
        background: (3,) colour behind both the truth and the render.
        lpips: from ``load_lpips``.
        regions: of the split of the images; None: they are not measured.

    Raises:
        DyngsError: a value that is not finite, naming the view.
    """
    scores: list[ViewScore] = []
    reasons: dict[str, str] = {}
    for image in images:
        if not scores:
            _timed_render(scene, image, options, background)  # the warm-up
        rendering, seconds, deform_seconds = _timed_render(scene, image, options, background)
        rendered = rendering.rgb[0]
        if not rendered.isfinite().all():
            raise DyngsError(f"view {image.name!r}: the render holds NaN or Inf")
        truth, mask = image.composite(background), image.mask
        people = {} if avatar_of(scene) is None else person_scores(image, rendering, background, lpips)
        parts = RegionScores() if regions is None else regions.scores(image, rendered, truth)
        halves = right_half_scores(image, rendering, background)
        optional = {"flip": flip(rendered, truth, mask), "lpips": lpips(rendered, truth, mask)}
        for name, metric in optional.items():
            if metric.reason is not None:
                reasons.setdefault(name, metric.reason)
        score = ViewScore(
            name=image.name,
            width=image.cameras.width,
            height=image.cameras.height,
            psnr=psnr(rendered, truth, mask),
            ssim=ssim(rendered, truth, mask),
            flip=optional["flip"].value,
            lpips=optional["lpips"].value,
            render_seconds=seconds,
            deform_seconds=deform_seconds,
            time=image.time,
            psnr_foreground=parts.foreground,
            psnr_moving=parts.moving,
            psnr_static=parts.still,
            psnr_right=halves.plain,
            psnr_right_fitted=halves.fitted,
            **people,
        )
        _require_finite(score, mask)
        scores.append(score)
    return scores, reasons


def means_of(scores: Sequence[ViewScore]) -> dict[str, Any]:
    """Return the means of the metrics that exist for poses as given and for fitted ones."""
    names = "psnr ssim lpips psnr_person ssim_person psnr_black ssim_black lpips_black"
    return {name: mean_of([getattr(score, name) for score in scores]) for name in names.split()}


def mean_of(values: Sequence[float | None]) -> float | None:
    """Return the mean of at least one value, None where one is None."""
    known = [value for value in values if value is not None]
    return fmean(known) if len(known) == len(values) else None


def _timed_render(
    scene: Renderable, image: Image, options: DrawOptions, background: Tensor
) -> tuple[Rendering, float, float]:
    """Return the rendering, the seconds it took, and the seconds of these for deformation."""
    with torch.no_grad():
        device = scene.device
        finish(device)
        start = time.perf_counter()
        moment = scene.time_step(image.time)
        finish(device)
        deformed = time.perf_counter()
        rendering = scene.render(image.cameras, moment, options=options, background=background)
        finish(device)
        end = time.perf_counter()
    return rendering, end - start, deformed - start


def _require_finite(score: ViewScore, mask: Tensor | None) -> None:
    for name in ("psnr", "ssim", "flip", "lpips"):
        value = getattr(score, name)
        if value is not None and not math.isfinite(value):
            empty = mask is not None and not bool((mask > 0).any())
            why = "its mask ignores every pixel" if empty else "the image holds NaN or Inf"
            raise DyngsError(f"view {score.name!r}: {name} is not finite, {why}")
