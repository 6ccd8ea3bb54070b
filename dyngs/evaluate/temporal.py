"""Quality of a model over time: at each time step, and the flicker of its images before a fixed
camera.

Both measures of flicker are in grey levels of 255 and mean absolute values over pixels, channels
and time steps, of images clamped to [0, 1]. Local letters: R a rendered image, G the true one, t
its time, k time steps in order.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.core.metrics import MetricValue
from dyngs.data.capture import View
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import static_cameras
from dyngs.evaluate.view_scores import Drawing

MAX_MOMENTS = 60  # number of training times up to which flicker is measured at all of them

_SAMPLED_TRIPLES = MAX_MOMENTS // 3
_NO_TIMES = "the images have no times"


@dataclass(frozen=True)
class TimeScore:
    """PSNR (dB) at one time step: the mean of the views taken then."""

    time: float
    psnr: float
    num_views: int


def clamped_times(times: Sequence[float]) -> tuple[tuple[float, ...], tuple[str, ...]]:
    """Return ``times`` within [0, 1], and a line of warning where one was not."""
    if not all(math.isfinite(t) for t in times):
        raise DyngsError(
            f"times must be finite numbers in [0, 1], got {', '.join(f'{t:g}' for t in times)}"
        )
    inside = tuple(min(max(float(t), 0.0), 1.0) for t in times)
    count = sum(a != b for a, b in zip(times, inside, strict=True))
    if not count:
        return inside, ()
    return inside, (f"{count} of {len(times)} times lie outside [0, 1] and were clamped to it",)


def psnr_per_time(scores: Iterable[tuple[float | None, float]]) -> tuple[TimeScore, ...]:
    """Return the PSNR at each distinct time, ascending, from (time, psnr) of the views that have a
    time."""
    found: defaultdict[float, list[float]] = defaultdict(list)
    for time, value in scores:
        if time is not None:
            found[time].append(value)
    return tuple(
        TimeScore(time, fmean(values), len(values)) for time, values in sorted(found.items())
    )


def flicker(drawing: Drawing, cameras: Cameras, times: Sequence[float]) -> MetricValue:
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
    sampled = np.linspace(1, last - 1, _SAMPLED_TRIPLES).round().astype(int).tolist()
    for k in range(1, last) if last < MAX_MOMENTS else sampled:
        seen = {
            i: seen[i] if i in seen else drawing.image(cameras, times[i]).clamp(0, 1)
            for i in (k - 1, k, k + 1)
        }
        before, now, after = (times[i] for i in (k - 1, k, k + 1))
        line = torch.lerp(seen[k + 1], seen[k - 1], (after - now) / (after - before))
        values.append(2 * 255 * float((line - seen[k]).abs().double().mean()))
    return MetricValue(fmean(values))


def flicker_error(drawing: Drawing, loader: ImageLoader, views: Sequence[View]) -> MetricValue:
    """Return the mean of |(R_{k+1} - R_k) - (G_{k+1} - G_k)| x 255: the error of changes in time,
    at fixed cameras.

    Over all neighbours in time of each pose that has several times; a mask leaves out what does not
    count in one of the two. Something that should move but does not has it, as has everything that
    flickers.
    """
    if all(view.time is None for view in views):
        return MetricValue(None, _NO_TIMES)
    total, weight = 0.0, 0.0
    for indices in static_cameras(views):
        errors = (_signed_error(drawing, loader[i]) for i in indices)
        before, counted = next(errors)
        for now, counts in errors:
            weights = torch.minimum(counted, counts)
            total += float(((now - before).abs().mean(-1) * weights).double().sum())
            weight += float(weights.double().sum())
            before, counted = now, counts
    if not weight:
        return MetricValue(None, "no camera of this split stands still while time passes")
    return MetricValue(255 * total / weight)


def flicker_of_split(drawing: Drawing, loader: ImageLoader, views: Sequence[View]) -> MetricValue:
    """Return ``flicker`` before the first camera of the split, at the training times."""
    if all(view.time is None for view in views):
        return MetricValue(None, _NO_TIMES)
    return flicker(drawing, loader[0].cameras, drawing.scene.times)


def _signed_error(drawing: Drawing, image: Image) -> tuple[Tensor, Tensor]:
    """Return (H, W, 3) render minus truth and its mask (H, W): R' - R - (G' - G) is the difference
    of two of them."""
    truth = image.composite(drawing.background).clamp(0, 1)
    counts = torch.ones(truth.shape[:2], device=truth.device) if image.mask is None else image.mask
    return drawing.image(image.cameras, image.time).clamp(0, 1) - truth, counts
