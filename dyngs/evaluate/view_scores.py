"""Scores of single views, and their means: the render against the truth, and how long it took to
draw.

Of people also inside their box, and on black, as published figures have it. Where training images
differ in exposure, so do test images: the published protocol (Martin-Brualla et al. 2021) fits the
left half, and scores the right half.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.core.metrics import Lpips, flip, psnr, ssim
from dyngs.data.images.maps import silhouette_box
from dyngs.data.loader import Image
from dyngs.evaluate.regions import Regions
from dyngs.gaussians.colour.affine import fitted_affine, recoloured
from dyngs.human.avatar.scene import avatar_of
from dyngs.models.renderable import DrawOptions, Renderable, Rendering
from dyngs.models.views import background_colour
from dyngs.ops.device import finish


@dataclass(frozen=True)
class Drawing:
    """A scene and how it is drawn."""

    scene: Renderable
    options: DrawOptions  # as in training, without depth
    background: Tensor  # (3,) colour
    scale: float = 1.0  # width and height drawn, relative to those of the image

    @torch.no_grad()
    def image(self, cameras: Cameras, time: float | None) -> Tensor:
        """Return the image (H, W, 3) of the one camera at ``time``; upscaled bilinearly if
        ``scale`` < 1."""
        small = cameras.scaled(self.scale)
        rgb = self.scene.render(small, time, options=self.options, background=self.background).rgb[
            0
        ]
        size = (cameras.height, cameras.width)
        if rgb.shape[:2] == size:
            return rgb
        upscaled = torch.nn.functional.interpolate(
            rgb.permute(2, 0, 1)[None], size=size, mode="bilinear"
        )
        return upscaled[0].permute(1, 2, 0)


def seconds_in_turn(
    drawings: Sequence[Drawing], images: Sequence[Image], rounds: int
) -> np.ndarray:
    """Return the seconds (D, ``rounds`` * I) that each of D drawings takes for each image.

    All draw each image in turn, starting with another one each time, so that other load on the
    machine affects all alike. ``images``: I; their cameras and times are drawn.
    """
    seconds = np.zeros((len(drawings), rounds * len(images)))
    for drawing in drawings:
        drawing.image(images[0].cameras, images[0].time)  # warm-up
    for column in range(seconds.shape[1]):
        image = images[column % len(images)]
        for turn in range(len(drawings)):
            row = (column + turn) % len(drawings)
            start = time.perf_counter()
            finish(drawings[row].image(image.cameras, image.time).device)
            seconds[row, column] = time.perf_counter() - start
    return seconds


@dataclass(frozen=True)
class ViewScore:
    """Metrics of one view; None where a metric cannot be had (``EvalReport.reasons`` says why).

    ``render_seconds`` holds ``deform_seconds``. Of images with alpha, ``psnr_white`` and
    ``psnr_black`` are of the full image on white and on black. Of people, ``psnr_person`` and
    ``ssim_person`` are inside the person's box, ``ssim_black`` and ``lpips_black`` on black.
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
    psnr_things: dict[int, float] = field(default_factory=dict)
    psnr_right: float | None = None
    psnr_right_fitted: float | None = None
    psnr_white: float | None = None
    psnr_black: float | None = None
    ssim_black: float | None = None
    lpips_black: float | None = None


@dataclass(frozen=True)
class PoseScores:
    """Means over views of a person in poses that were fitted to these views themselves; names as in
    ``ViewScore``."""

    psnr: float
    ssim: float
    lpips: float | None
    psnr_person: float | None
    ssim_person: float | None
    psnr_black: float | None
    ssim_black: float | None
    lpips_black: float | None
    updates: float  # mean number of updates that the pose of a moment took
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

    The scene is drawn at the time of each image on ``background`` (3,); ``regions`` are of the
    split, None: not measured.
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
        truth = image.composite(background)
        mask = image.mask
        people = (
            {} if avatar_of(scene) is None else person_scores(image, rendering, background, lpips)
        )
        parts = right_half_scores(image, rendering, background)
        parts |= background_scores(image, rendering, background)
        parts |= {} if regions is None else regions.scores(image, rendered, truth)
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
            psnr_things={} if regions is None else regions.scores_of_things(image, rendered, truth),
            **parts,
            **people,
        )
        _require_finite(score, mask)
        scores.append(score)
    return scores, reasons


def person_scores(
    image: Image, rendering: Rendering, background: Tensor, lpips: Lpips
) -> dict[str, float | None]:
    """Return the scores by their names in ``ViewScore``; none where nobody is to be seen."""
    box = None if image.alpha is None else silhouette_box(image.alpha)
    if box is None:
        return {}
    truth = image.composite(background)
    mask = image.mask
    rendered = rendering.rgb[0]
    inside = None if mask is None else mask[box]
    black = rendered - rendering.transmittance[0][..., None] * background
    return {
        "psnr_person": psnr(rendered[box], truth[box], inside),
        "ssim_person": ssim(rendered[box], truth[box], inside),
        "ssim_black": ssim(black, image.rgb_premultiplied, mask),
        "lpips_black": lpips(black, image.rgb_premultiplied, mask).value,
    }


def background_scores(
    image: Image, rendering: Rendering, background: Tensor
) -> dict[str, float | None]:
    """Return ``psnr_white`` and ``psnr_black``, dB, from one rendering on ``background`` (3,); None
    without alpha."""
    scores: dict[str, float | None] = {"psnr_white": None, "psnr_black": None}
    if image.alpha is None:
        return scores
    for name in ("white", "black"):
        colour = background_colour(name).to(background)
        shown = rendering.rgb[0] + rendering.transmittance[0][..., None] * (colour - background)
        scores[f"psnr_{name}"] = psnr(shown, image.composite(colour), image.mask)
    return scores


def right_half_scores(
    image: Image, rendering: Rendering, background: Tensor
) -> dict[str, float | None]:
    """Return ``psnr_right`` and ``psnr_right_fitted``, dB; None where a half of the image has no
    pixel that counts.

    That is the PSNR of the right half as the scene shows it, and after an affine colour fitted on
    the left half.
    """
    truth = image.composite(background)
    left = torch.zeros_like(truth[..., 0])
    middle = left.shape[1] // 2
    left[:, :middle] = 1
    counts = left + 1 if image.mask is None else image.mask
    if not all(bool((half > 0).any()) for half in (counts[:, :middle], counts[:, middle:])):
        return {"psnr_right": None, "psnr_right_fitted": None}
    affine = fitted_affine([(image, rendering)], background, left)
    fitted = recoloured(affine, image, rendering, background)
    mask = None if image.mask is None else image.mask[:, middle:]
    return {
        "psnr_right": psnr(rendering.rgb[0][:, middle:], truth[:, middle:], mask),
        "psnr_right_fitted": psnr(fitted[:, middle:], truth[:, middle:], mask),
    }


_OF_POSES = (
    "psnr",
    "ssim",
    "lpips",
    "psnr_person",
    "ssim_person",
    "psnr_black",
    "ssim_black",
    "lpips_black",
)


def means_of(scores: Sequence[ViewScore], names: Sequence[str] = _OF_POSES) -> dict[str, Any]:
    """Return the means of metrics; by default those that exist for poses of the capture and for
    fitted ones."""
    return {name: mean_of([getattr(score, name) for score in scores]) for name in names}


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
