"""Scores of rendered views against the true images: whole image, regions, changes over time, speed.

People are also scored inside their bounding box and on black, as in published results. With
differing exposures, an affine colour map is fitted on the left half of a view and the right half is
scored (Martin-Brualla et al. 2021).

Local letters: H x W pixels.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from statistics import fmean
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.core.metrics import Lpips, flip, psnr, ssim
from dyngs.data.capture import View
from dyngs.data.geometry import project_points
from dyngs.data.images.maps import silhouette_box
from dyngs.data.loader import Image
from dyngs.data.times import static_cameras
from dyngs.evaluate.motion_masks import MotionMasks, erode
from dyngs.gaussians.colour.network import apply_affine_colour, fit_affine_colour
from dyngs.human.avatar.scene import as_human_scene
from dyngs.models.renderable import DrawOptions, Renderable, Rendering
from dyngs.models.views import background_colour
from dyngs.ops.device import synchronize

REGION_METRICS = (
    "psnr_foreground",
    "psnr_moving",
    "psnr_static",
    "ssim_moving",
    "flip_moving",
)

FEWEST_PIXELS = 25  # Regions with fewer pixels in a view are not scored

# Pixels on which FLIP is computed per split: it takes several times as long as rendering on a GPU
FLIP_PIXELS = 20e6
# Opacity in the interior of an object, below which a pixel is see-through
SOLID = 0.9

NO_ALPHA = "the images have no alpha"
NO_TIMES = "the images have no times"
NO_MOTION_KNOWN = "no motion masks, and too few times to estimate them"
TOO_SMALL = f"fewer than {FEWEST_PIXELS} pixels in each view"


@dataclass
class _OverTime:
    """Sums over views of the colours of P places, of rendering and image, float64."""

    sums: Tensor  # (2, P, 3)
    squares: Tensor
    counts: Tensor  # (P,) views that show the place
    is_static: Tensor  # (P,) bool, in all of these

    def add(self, pair: Tensor, is_shown: Tensor, is_static: Tensor) -> None:
        """Add the colours (2, P, 3) of a view, where ``is_shown`` (P,)."""
        pair = pair.double() * is_shown[:, None]
        self.sums += pair
        self.squares += pair.square()
        self.counts += is_shown
        self.is_static &= is_static | ~is_shown

    def deviations(self) -> Tensor:
        """Return the standard deviations over time (2, P', 3) of the static places of two views or
        more."""
        chosen = self.is_static & (self.counts > 1)
        count = self.counts[chosen, None]
        variances = self.squares[:, chosen] - self.sums[:, chosen].square() / count
        return (variances / (count - 1)).clamp_min(0).sqrt()


class Regions:
    """Foreground, moving and static regions of the images of one split.

    The foreground is where the true alpha is positive. The moving region is taken from the motion
    masks of the capture, else estimated, see ``motion_masks``. The static region is the remainder.
    With a foreground, both are restricted to it.

    Args:
        views: views of the split.
        masks: estimates the moving region. None: unknown without motion masks of the capture.
        points: sparse points (P, 3) of the capture, by which the flicker of moving cameras is
            measured.
    """

    def __init__(
        self,
        views: Sequence[View],
        masks: MotionMasks | None = None,
        points: np.ndarray | None = None,
    ) -> None:
        self._views = {view.name: view for view in views}
        self._masks = masks
        self._points = points
        self._has_times = any(view.time is not None for view in views)
        self._moving_from: set[str] = set()
        self._has_alpha = False
        self._fixed_camera = {
            views[i].name: number for number, seen in enumerate(static_cameras(views)) for i in seen
        }
        self._over_time: dict[int | None, _OverTime] = {}

    def scores(
        self, image: Image, rendered: Tensor, truth: Tensor, with_flip: bool = False
    ) -> dict[str, float | None]:
        """Return the scores of the regions of a view, by metric; PSNR in dB. None for unknown or
        small regions."""
        moves = self.moving(image)
        foreground = None if image.alpha is None else image.alpha > 0
        self._has_alpha |= foreground is not None
        parts = {"psnr_foreground": foreground, "psnr_moving": moves}
        parts["psnr_static"] = None if moves is None else ~moves
        scores: dict[str, float | None] = dict.fromkeys(REGION_METRICS)
        for metric, part in parts.items():
            weights = _weights(part, foreground, image.mask)
            if weights is None:
                continue
            scores[metric] = psnr(rendered, truth, weights)
            if metric == "psnr_static":
                self._add_view(image, torch.stack([rendered, truth]), weights > 0)
            if metric == "psnr_moving":
                scores["ssim_moving"] = ssim(rendered, truth, weights)
                scores["flip_moving"] = flip(rendered, truth, weights).value if with_flip else None
        return scores

    def flicker(self) -> dict[str, float]:
        """Return the mean standard deviations over time of what is static, of renderings and
        images: pixels of fixed cameras, sparse points before others. Empty without these."""
        found = [x.deviations() for x in self._over_time.values()]
        if not sum(x.shape[1] for x in found):
            return {}
        rendered, images = torch.cat(found, dim=1).mean((1, 2))
        return {"flicker_static": float(rendered), "flicker_static_images": float(images)}

    def _add_view(self, image: Image, pair: Tensor, is_static: Tensor) -> None:
        """Add the colours (2, H, W, 3) of rendering and image to the sums over time."""
        camera = self._fixed_camera.get(image.name)
        pair = pair.flatten(1, 2)
        is_static = is_static.flatten()
        is_shown = torch.ones_like(is_static)
        if camera is None:
            if self._points is None:
                return
            positions, shown = project_points(self._points, self._views[image.name])
            across, down = (positions * (image.cameras.width, image.cameras.height)).T
            pixels = np.where(shown, np.floor(down) * image.cameras.width + np.floor(across), 0)
            pixel = torch.from_numpy(pixels.astype(np.int64)).to(pair.device)
            pair = pair[:, pixel]
            is_static = is_static[pixel]
            is_shown = torch.from_numpy(shown).to(pair.device)
        if camera not in self._over_time:
            zeros = torch.zeros_like(pair, dtype=torch.float64)
            counts = torch.zeros_like(zeros[0, :, 0])
            self._over_time[camera] = _OverTime(zeros, zeros.clone(), counts, counts == 0)
        self._over_time[camera].add(pair, is_shown, is_static)

    def moving(self, image: Image) -> Tensor | None:
        """Return the moving pixels (H, W) bool, or None if unknown."""
        if image.motion_mask is not None:
            self._moving_from.add("motion masks")
            return image.motion_mask >= 0.5
        if self._masks is None:
            return None
        height, width = image.rgb_premultiplied.shape[:2]
        mask = self._masks.mask(self._views[image.name], width, height)
        if mask is not None:
            self._moving_from.add("change over time")
            mask = mask.to(image.rgb_premultiplied.device)
        return mask

    @property
    def moving_from(self) -> str | None:
        """Source of the moving regions of the scored images, or None."""
        return " and ".join(sorted(self._moving_from)) or None

    def reason(self, metric: str) -> str:
        """Return the reason why no scored image has a value for this region."""
        if metric == "psnr_foreground":
            return TOO_SMALL if self._has_alpha else NO_ALPHA
        if self._moving_from:
            return TOO_SMALL
        return NO_MOTION_KNOWN if self._has_times else NO_TIMES


def _weights(part: Tensor | None, foreground: Tensor | None, mask: Tensor | None) -> Tensor | None:
    """Return the weights (H, W) of a region inside the foreground; None for unknown or small
    regions."""
    if part is None:
        return None
    inside = part if foreground is None else part & foreground
    weights = inside.float() if mask is None else inside * mask
    return weights if int((weights > 0).sum()) >= FEWEST_PIXELS else None


@dataclass(frozen=True)
class SceneRenderer:
    """A scene with render options and background."""

    scene: Renderable
    options: DrawOptions  # as in training, without depth
    background: Tensor  # (3,) colour

    @torch.no_grad()
    def image(self, cameras: Cameras, time: float | None) -> Tensor:
        """Render the image (H, W, 3) of one camera at ``time``."""
        rendering = self.scene.render(
            cameras, time, options=self.options, background=self.background
        )
        return rendering.rgb[0]


def time_renders(
    drawings: Sequence[SceneRenderer], images: Sequence[Image], rounds: int
) -> np.ndarray:
    """Return the seconds (D, ``rounds`` * I) that D renderers take for I images.

    Renderers alternate on each image, so that other load affects all equally.
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
    """Metrics of one view. None if a metric is unavailable, see ``EvalReport.reasons``.

    ``render_seconds`` includes ``deform_seconds``. ``psnr_white`` and ``psnr_black`` are of images
    with alpha, on these backgrounds. ``psnr_person`` and ``ssim_person`` are inside the person's
    bounding box, ``ssim_black`` and ``lpips_black`` on black.
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
    ssim_moving: float | None = None
    flip_moving: float | None = None
    psnr_right: float | None = None
    psnr_right_fitted: float | None = None
    psnr_white: float | None = None
    psnr_black: float | None = None
    ssim_black: float | None = None
    lpips_black: float | None = None
    see_through: float | None = None  # fraction of the interior with opacity below ``SOLID``


@dataclass(frozen=True)
class PoseScores:
    """Mean scores of a person in poses fitted to the evaluated views. Names as in ``ViewScore``."""

    psnr: float
    ssim: float
    lpips: float | None
    psnr_person: float | None
    ssim_person: float | None
    psnr_black: float | None
    ssim_black: float | None
    lpips_black: float | None
    updates: float  # mean number of optimizer updates per pose
    per_view: tuple[ViewScore, ...]


def score_views(
    scene: Renderable,
    images: Iterable[Image],
    options: DrawOptions,
    background: Tensor,
    lpips: Lpips,
    regions: Regions | None = None,
    flip_every: int = 1,
) -> tuple[list[ViewScore], dict[str, str]]:
    """Return the scores of a scene on images, and the reasons for metrics that are None.

    Args:
        background: (3,) colour behind rendering and image.
        regions: regions of the split. None scores no regions.
        flip_every: FLIP is computed for the first of this many views. 0 for none.
    """
    scores: list[ViewScore] = []
    reasons: dict[str, str] = {}
    for image in images:
        if not scores:
            _timed_render(scene, image, options, background)  # warm-up
        rendering, seconds, deform_seconds = _timed_render(scene, image, options, background)
        rendered = rendering.rgb[0]
        if not rendered.isfinite().all():
            raise DyngsError(f"view {image.name!r}: the rendering contains NaN or Inf")
        truth = image.composite(background)
        mask = image.mask
        values: dict[str, Any] = {
            "psnr": psnr(rendered, truth, mask),
            "ssim": ssim(rendered, truth, mask),
        }
        for name, metric in (("flip", flip), ("lpips", lpips)):
            if name == "flip" and (flip_every == 0 or len(scores) % flip_every):
                values[name] = None
                continue
            result = metric(rendered, truth, mask)
            values[name] = result.value
            if result.reason is not None:
                reasons.setdefault(name, result.reason)
        for name, value in values.items():
            if value is not None and not math.isfinite(value):
                empty = mask is not None and not bool((mask > 0).any())
                why = "all pixels are masked" if empty else "the image contains NaN or Inf"
                raise DyngsError(f"view {image.name!r}: {name} is not finite ({why})")
        if as_human_scene(scene) is not None:
            values |= person_scores(image, rendering, background, lpips)
        values |= right_half_scores(image, rendering, background)
        values |= background_scores(image, rendering, background)
        if regions is not None:
            with_flip = values["flip"] is not None
            values |= regions.scores(image, rendered, truth, with_flip)
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
    """Return the scores of a person, by their names in ``ViewScore``. Empty if no person is
    visible."""
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
    """Return ``psnr_white`` and ``psnr_black`` in dB from one rendering on ``background`` (3,), and
    ``see_through``. Empty without alpha."""
    scores: dict[str, float] = {}
    for name in ("white", "black") if image.alpha is not None else ():
        colour = background_colour(name).to(background)
        shown = rendering.rgb[0] + rendering.transmittance[0][..., None] * (colour - background)
        scores[f"psnr_{name}"] = psnr(shown, image.composite(colour), image.mask)
    if image.alpha is not None:
        # Silhouettes are slightly off in every scene: edges are no sign of wrong opacities.
        interior = erode(image.alpha >= 0.999, radius=2)
        holes = interior & (rendering.alpha[0] < SOLID)
        scores["see_through"] = int(holes.sum()) / max(int(interior.sum()), 1)
    return scores


def right_half_scores(image: Image, rendering: Rendering, background: Tensor) -> dict[str, float]:
    """Return the PSNR of the right half in dB, without and with an affine colour map fitted on the
    left half.

    Empty if all pixels of one half are masked.
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
    """Return the means of metrics over views.

    None if a view lacks the metric. FLIP and region metrics are means over the views that have it.
    """
    means = {}
    for name in names:
        values = [getattr(score, name) for score in scores]
        known = [value for value in values if value is not None]
        counts = name in (*REGION_METRICS, "flip") or len(known) == len(values)
        means[name] = fmean(known) if known and counts else None
    return means


def _timed_render(
    scene: Renderable, image: Image, options: DrawOptions, background: Tensor
) -> tuple[Rendering, float, float]:
    """Return a rendering, its total seconds, and the seconds of deformation."""
    with torch.no_grad():
        device = scene.device
        synchronize(device)
        start = time.perf_counter()
        moment = scene.drawing_step(image.time)
        synchronize(device)
        apply_offsets = time.perf_counter()
        rendering = scene.render(image.cameras, moment, options=options, background=background)
        synchronize(device)
        end = time.perf_counter()
    return rendering, end - start, apply_offsets - start


@dataclass(frozen=True)
class TimeScore:
    """Mean PSNR in dB of the views at one time step."""

    time: float
    psnr: float
    num_views: int


def psnr_per_time(scores: Iterable[tuple[float | None, float]]) -> tuple[TimeScore, ...]:
    """Return the PSNR at each distinct time, ascending, from (time, psnr) pairs. Views without a
    time are skipped."""
    by_time: defaultdict[float, list[float]] = defaultdict(list)
    for at, value in scores:
        if at is not None:
            by_time[at].append(value)
    return tuple(
        TimeScore(time, fmean(values), len(values)) for time, values in sorted(by_time.items())
    )
