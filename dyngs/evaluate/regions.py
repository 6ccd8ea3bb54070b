"""Parts of images that are measured on their own: the foreground, what moves, and what does not.

Local letters: T images of a camera, H x W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from dyngs.core.metrics import psnr
from dyngs.data.capture import View
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import evenly_spaced, static_cameras

RegionMetric = Literal["psnr_foreground", "psnr_moving", "psnr_static"]
REGION_METRICS: tuple[RegionMetric, ...] = ("psnr_foreground", "psnr_moving", "psnr_static")

# a region of fewer pixels in a view is not measured there: a few pixels of an outline say nothing
FEWEST_PIXELS = 25
CHANGE = 0.05
"""Mean difference of the channels from the camera's median, in [0, 1], from which a pixel counts as
moving."""
MEDIAN_IMAGES = 31  # number of images, spread over the clip, from which a camera's median is taken
FEWEST_IMAGES = 3

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
            if len(indices) >= FEWEST_IMAGES
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
        inside = (
            torch.ones_like(truth[..., 0], dtype=torch.bool) if foreground is None else foreground
        )
        parts = {
            "psnr_foreground": foreground,
            "psnr_moving": None if moves is None else moves & inside,
            "psnr_static": None if moves is None else ~moves & inside,
        }
        return {
            metric: _psnr_inside(part, image, rendered, truth) for metric, part in parts.items()
        }

    def scores_of_things(self, image: Image, rendered: Tensor, truth: Tensor) -> dict[int, float]:
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
        if image.moves is not None:
            self._moving_from.add("motion masks")
            return image.moves >= 0.5
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

    def reason(self, metric: RegionMetric) -> str:
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
