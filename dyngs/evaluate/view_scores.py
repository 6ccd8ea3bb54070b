"""Scores of views: the render against the truth, whole, on parts of the image and over time, and how
long it took to draw.

Of people also inside their box, and on black, as published figures have it. Where training images
differ in exposure, so do test images: the published protocol (Martin-Brualla et al. 2021) fits the
left half, and scores the right half. Both measures of flicker are in grey levels of 255 and mean
absolute values over pixels, channels and time steps, of images clamped to [0, 1]. Local letters: T
images of a camera, H x W pixels, R a rendered image, G the true one, t its time, k time steps in
order.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from statistics import fmean
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.core.metrics import Lpips, MetricValue, flip, psnr, ssim
from dyngs.data.capture import View
from dyngs.data.images.maps import silhouette_box
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import evenly_spaced, static_cameras
from dyngs.gaussians.colour.network import apply_affine_colour, fit_affine_colour
from dyngs.human.avatar.scene import as_human_scene
from dyngs.models.renderable import DrawOptions, Renderable, Rendering
from dyngs.models.views import background_colour
from dyngs.ops.device import synchronize

REGION_METRICS = ("psnr_foreground", "psnr_moving", "psnr_static")

# a region of fewer pixels in a view is not measured there: a few pixels of an outline say nothing
FEWEST_PIXELS = 25
CHANGE = 0.05
"""Mean difference of the channels from the camera's median, in [0, 1], from which a pixel counts as
moving."""
MEDIAN_IMAGES = 31  # number of images, spread over the clip, from which a camera's median is taken

NO_ALPHA = "the images have no alpha and no silhouettes"
NO_TIMES = "the images have no times"
NO_MOTION_KNOWN = (
    "the views have no motion masks, and no camera of this split stands still while time passes"
)
TOO_SMALL = f"fewer than {FEWEST_PIXELS} pixels in every view"


class Regions:
    """The regions of the images of one split; ``loader`` holds those of ``views``, ``background``
    (3,) is behind them.

    The foreground is where the true image is not fully transparent. What moves is known, in this
    order, from motion masks, and before cameras that stand still from pixels that differ by
    ``CHANGE`` from their median over time. What is left does not move. Where there is a foreground,
    both are parts of it.
    """

    def __init__(self, views: Sequence[View], loader: ImageLoader, background: Tensor) -> None:
        self._loader, self._background = loader, background
        self._cameras = {
            views[i].name: indices
            for indices in static_cameras(views)
            if len(indices) >= 3
            for i in indices
        }
        self._medians: dict[tuple[int, ...], Tensor] = {}
        self._has_times = any(view.time is not None for view in views)
        self._moving_from: set[str] = set()
        self._has_alpha = False

    def scores(self, image: Image, rendered: Tensor, truth: Tensor) -> dict[str, float | None]:
        """Return the PSNR of a view's regions, dB, by metric; None for too few such pixels, or
        unknown ones."""
        moves = self.moving(image)
        foreground = None if image.alpha is None else image.alpha > 0
        self._has_alpha |= foreground is not None
        parts: list[Tensor | None] = [foreground, None, None]
        if moves is not None:
            parts[1:] = [x if foreground is None else x & foreground for x in (moves, ~moves)]
        found = [_psnr_inside(part, image, rendered, truth) for part in parts]
        return dict(zip(REGION_METRICS, found, strict=True))

    def object_scores(self, image: Image, rendered: Tensor, truth: Tensor) -> dict[int, float]:
        """Return the PSNR of a view, dB, on each thing that its motion mask tells apart and that it
        shows, by label."""
        if image.labels is None:
            return {}
        labels = image.labels if image.alpha is None else image.labels * (image.alpha > 0)
        found = labels[labels != 0].unique().cpu().tolist()
        scores = {label: _psnr_inside(labels == label, image, rendered, truth) for label in found}
        return {label: score for label, score in scores.items() if score is not None}

    def moving(self, image: Image) -> Tensor | None:
        """Return (H, W) bool, the pixels in which something moves; None where that is not known."""
        if image.motion_mask is not None:
            self._moving_from.add("motion masks")
            return image.motion_mask >= 0.5
        indices = self._cameras.get(image.name)
        if indices is None:
            return None
        self._moving_from.add("change over time")
        change = (image.composite(self._background) - self._median(indices)).abs().mean(-1)
        return _opened(change > CHANGE)

    @property
    def moving_from(self) -> str | None:
        """How it was found what moves in the images so far; None where it was not."""
        return " and ".join(sorted(self._moving_from)) or None

    def reason(self, metric: str) -> str:
        """Return why no image so far has a score of this region."""
        if metric == "psnr_foreground":
            return TOO_SMALL if self._has_alpha else NO_ALPHA
        if self._moving_from:
            return TOO_SMALL
        return NO_MOTION_KNOWN if self._has_times else NO_TIMES

    def _median(self, indices: Sequence[int]) -> Tensor:
        """Return the (H, W, 3) median over time of the images of a camera that stands still."""
        key = tuple(indices)
        if key not in self._medians:
            chosen = [indices[i] for i in evenly_spaced(len(indices), MEDIAN_IMAGES)]
            shown = [
                (255 * self._loader[i].composite(self._background).clamp(0, 1)).round().byte()
                for i in chosen
            ]
            self._medians[key] = torch.stack(shown).median(dim=0).values
        return self._medians[key].float() / 255


def _psnr_inside(
    part: Tensor | None, image: Image, rendered: Tensor, truth: Tensor
) -> float | None:
    if part is None:
        return None
    weights = part.float() if image.mask is None else part * image.mask
    return psnr(rendered, truth, weights) if int((weights > 0).sum()) >= FEWEST_PIXELS else None


def _opened(shown: Tensor) -> Tensor:
    """Return (H, W) bool, ``shown`` less what no square of 3x3 pixels fits into."""
    grown = torch.nn.functional.max_pool2d((~shown)[None, None].float(), 3, stride=1, padding=1)
    kept = 1 - grown
    return torch.nn.functional.max_pool2d(kept, 3, stride=1, padding=1)[0, 0] > 0.5


@dataclass(frozen=True)
class SceneRenderer:
    """A scene and how it is drawn."""

    scene: Renderable
    options: DrawOptions  # as in training, without depth
    background: Tensor  # (3,) colour

    @torch.no_grad()
    def image(self, cameras: Cameras, time: float | None) -> Tensor:
        """Return the image (H, W, 3) of the one camera at ``time``."""
        rendering = self.scene.render(
            cameras, time, options=self.options, background=self.background
        )
        return rendering.rgb[0]


def time_renders(
    drawings: Sequence[SceneRenderer], images: Sequence[Image], rounds: int
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
            synchronize(drawings[row].image(image.cameras, image.time).device)
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
        values: dict[str, Any] = {
            "psnr": psnr(rendered, truth, mask),
            "ssim": ssim(rendered, truth, mask),
        }
        for name, metric in (("flip", flip), ("lpips", lpips)):
            found = metric(rendered, truth, mask)
            values[name] = found.value
            if found.reason is not None:
                reasons.setdefault(name, found.reason)
        for name, value in values.items():
            if value is not None and not math.isfinite(value):
                empty = mask is not None and not bool((mask > 0).any())
                why = "its mask ignores every pixel" if empty else "the image holds NaN or Inf"
                raise DyngsError(f"view {image.name!r}: {name} is not finite, {why}")
        if as_human_scene(scene) is not None:
            values |= person_scores(image, rendering, background, lpips)
        values |= right_half_scores(image, rendering, background)
        values |= background_scores(image, rendering, background)
        if regions is not None:
            values |= regions.scores(image, rendered, truth)
            values["psnr_things"] = regions.object_scores(image, rendered, truth)
        score = ViewScore(
            name=image.name,
            width=image.cameras.width,
            height=image.cameras.height,
            render_seconds=seconds,
            deform_seconds=deform_seconds,
            time=image.time,
            **values,
        )
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


def background_scores(image: Image, rendering: Rendering, background: Tensor) -> dict[str, float]:
    """Return ``psnr_white`` and ``psnr_black``, dB, from one rendering on ``background`` (3,); none
    without alpha."""
    scores: dict[str, float] = {}
    for name in ("white", "black") if image.alpha is not None else ():
        colour = background_colour(name).to(background)
        shown = rendering.rgb[0] + rendering.transmittance[0][..., None] * (colour - background)
        scores[f"psnr_{name}"] = psnr(shown, image.composite(colour), image.mask)
    return scores


def right_half_scores(image: Image, rendering: Rendering, background: Tensor) -> dict[str, float]:
    """Return ``psnr_right`` and ``psnr_right_fitted``, dB; none where a half of the image has no
    pixel that counts.

    That is the PSNR of the right half as the scene shows it, and after an affine colour fitted on
    the left half.
    """
    truth = image.composite(background)
    left = torch.zeros_like(truth[..., 0])
    middle = left.shape[1] // 2
    left[:, :middle] = 1
    mask = None if image.mask is None else image.mask[:, middle:]
    counts = left + 1 if image.mask is None else image.mask
    if not all(bool((half > 0).any()) for half in (counts[:, :middle], counts[:, middle:])):
        return {}
    affine = fit_affine_colour([(image, rendering)], background, left)
    fitted = apply_affine_colour(affine, image, rendering, background)
    return {
        "psnr_right": psnr(rendering.rgb[0][:, middle:], truth[:, middle:], mask),
        "psnr_right_fitted": psnr(fitted[:, middle:], truth[:, middle:], mask),
    }


POSE_METRICS = tuple(x.name for x in fields(PoseScores) if x.name not in ("updates", "per_view"))


def mean_scores(scores: Sequence[ViewScore], names: Sequence[str] = POSE_METRICS) -> dict[str, Any]:
    """Return the means of metrics over at least one view; None where a view has none, but for
    regions: these are over the views that have one."""
    means = {}
    for name in names:
        values = [getattr(score, name) for score in scores]
        known = [value for value in values if value is not None]
        counts = name in REGION_METRICS or len(known) == len(values)
        means[name] = fmean(known) if known and counts else None
    return means


def _timed_render(
    scene: Renderable, image: Image, options: DrawOptions, background: Tensor
) -> tuple[Rendering, float, float]:
    """Return the rendering, the seconds it took, and the seconds of these for deformation."""
    with torch.no_grad():
        device = scene.device
        synchronize(device)
        start = time.perf_counter()
        moment = scene.time_step(image.time)
        synchronize(device)
        apply_offsets = time.perf_counter()
        rendering = scene.render(image.cameras, moment, options=options, background=background)
        synchronize(device)
        end = time.perf_counter()
    return rendering, end - start, apply_offsets - start


@dataclass(frozen=True)
class TimeScore:
    """PSNR (dB) at one time step: the mean of the views taken then."""

    time: float
    psnr: float
    num_views: int


def psnr_per_time(scores: Iterable[tuple[float | None, float]]) -> tuple[TimeScore, ...]:
    """Return the PSNR at each distinct time, ascending, from (time, psnr) of the views that have a
    time."""
    found: defaultdict[float, list[float]] = defaultdict(list)
    for at, value in scores:
        if at is not None:
            found[at].append(value)
    return tuple(
        TimeScore(time, fmean(values), len(values)) for time, values in sorted(found.items())
    )


def flicker(drawing: SceneRenderer, cameras: Cameras, times: Sequence[float]) -> MetricValue:
    """Return the mean of |R_{k+1} - 2 R_k + R_{k-1}| x 255: the second difference in time at one
    camera, without truth.

    Where time steps are not evenly spaced, R_k is compared with the line between its neighbours: 2
    |w R_{k-1} + (1 - w) R_{k+1} - R_k| with
    w = (t_{k+1} - t_k) / (t_{k+1} - t_{k-1}). Of more than 60 time steps, 20 triples of
    neighbours are taken, evenly spaced. A scene in which nothing moves has 0.
    """
    if drawing.scene.is_static:
        return MetricValue(0.0)
    if len(times) < 3:
        return MetricValue(None, f"needs at least three training times, there are {len(times)}")
    seen: dict[int, Tensor] = {}
    values = []
    last = len(times) - 1
    num_triples = last - 1 if last < 60 else 20
    for k in np.linspace(1, last - 1, num_triples).round().astype(int).tolist():
        seen = {
            i: seen[i] if i in seen else drawing.image(cameras, times[i]).clamp(0, 1)
            for i in (k - 1, k, k + 1)
        }
        before, now, after = (times[i] for i in (k - 1, k, k + 1))
        line = torch.lerp(seen[k + 1], seen[k - 1], (after - now) / (after - before))
        values.append(2 * 255 * float((line - seen[k]).abs().double().mean()))
    return MetricValue(fmean(values))


def flicker_error(
    drawing: SceneRenderer, loader: ImageLoader, views: Sequence[View]
) -> MetricValue:
    """Return the mean of |(R_{k+1} - R_k) - (G_{k+1} - G_k)| x 255: the error of changes in time,
    at fixed cameras.

    Over all neighbours in time of each pose that has several times; a mask leaves out what does not
    count in one of the two. Something that should move but does not has it, as has everything that
    flickers.
    """
    total = weight = 0.0
    for indices in static_cameras(views):
        before: tuple[Tensor, Tensor] | None = None
        for image in (loader[i] for i in indices):
            # R' - R - (G' - G) is the difference of two errors
            truth = image.composite(drawing.background).clamp(0, 1)
            error = drawing.image(image.cameras, image.time).clamp(0, 1) - truth
            counts = torch.ones_like(truth[..., 0]) if image.mask is None else image.mask
            if before is not None:
                weights = torch.minimum(before[1], counts)
                total += float(((error - before[0]).abs().mean(-1) * weights).double().sum())
                weight += float(weights.double().sum())
            before = error, counts
    if not weight:
        return MetricValue(None, "no camera of this split stands still while time passes")
    return MetricValue(255 * total / weight)


def temporal_scores(
    drawing: SceneRenderer, loader: ImageLoader, views: Sequence[View]
) -> dict[str, MetricValue]:
    """Return ``flicker`` before the first camera of a split, at the training times, and
    ``flicker_error``."""
    if all(view.time is None for view in views):
        return dict.fromkeys(("flicker", "flicker_error"), MetricValue(None, NO_TIMES))
    return {
        "flicker": flicker(drawing, loader[0].cameras, drawing.scene.times),
        "flicker_error": flicker_error(drawing, loader, views),
    }
