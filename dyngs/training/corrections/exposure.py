"""Exposure and white balance of each training image, learned next to the scene.

A camera that chooses its exposure by itself shows the same place brighter in one image than in the
next. So each image has an affine colour, 3 x 4, that its rendering goes through before the loss, as
3DGS has since its second release. The mean over all images is the identity, so that the scene has
the colours of the mean image and not any.

Gains of all images are found at once, by the places that they share, as soon as the scene has a
depth; then Adam refines them. Adam alone is too slow for a short run, and leaves a scene bright
where bright images were taken.

Local letters: V views, M (V, 3, 4) deviations from the identity, matrix next to offset.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import torch
from torch import Tensor

from dyngs.config import TrainConfig
from dyngs.core.state import tensors_of
from dyngs.core.tensor_checks import require_tensor
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import videos
from dyngs.gaussians.colour.network import SATURATED, recoloured
from dyngs.gaussians.optimizer import AdamState
from dyngs.models.model import Correction, Look, Loss, RenderedView
from dyngs.ops.adam import Count
from dyngs.training.other_views import log_gains

WARM_UP = 0.25
"""Fraction of the run in which images are taken as they are: before, the rendering shows too little
to compare with."""
# How far a gain may move after it was found, at most: rates follow from how often an image is
# trained on
TRAVEL = 0.5
LAST_RATE = 0.02  # Rate at the end over that at the beginning, log-linear between
MAX_RATE = 0.01
MIXING_RATE = 0.05  # Rate of what mixes channels, and of offsets, over that of gains
GAIN_WEIGHT, MIXING_WEIGHT = 0.3, 1.0
"""Weights of the mean squared deviation from the identity: gains differ, channels hardly mix."""
# Weight of the mean square of its difference from the images before and after, in a video
SMOOTH_WEIGHT = 1.0


def exposures_of(options: TrainConfig, images: ImageLoader) -> ViewExposures | None:
    """Return what is learned of the exposures of training views, if that is asked for."""
    if options.exposure != "always":
        return None
    beside: list[list[int]] = [[] for _ in images.views]
    for order in videos(images.views):
        for one, next_one in pairwise(order):
            beside[one].append(next_one)
            beside[next_one].append(one)
    return ViewExposures(beside, options.steps, images)


class ViewExposures(Loss, Correction):
    """An affine colour per training image, and their Adam."""

    name = "exposures"

    def __init__(
        self, neighbours: Sequence[Sequence[int]], steps: int, images: ImageLoader | None = None
    ) -> None:
        count = len(neighbours)
        self._neighbours = [list(x) for x in neighbours]
        self._steps = steps
        self._begins = round(WARM_UP * steps)
        self._images = images
        self._visits = torch.zeros(count, dtype=torch.int64, device="cpu")
        self._values = torch.zeros(count, 12, device="cpu", requires_grad=True)
        self._adam = AdamState.zero({"values": self._values})
        mean = (1 - LAST_RATE) / -math.log(LAST_RATE)
        rate = min(MAX_RATE, TRAVEL * count / (steps * mean))
        is_gain = torch.eye(3, 4, device="cpu").flatten()
        self._rates = rate * (MIXING_RATE + (1 - MIXING_RATE) * is_gain)
        self._weights = MIXING_WEIGHT + (GAIN_WEIGHT - MIXING_WEIGHT) * is_gain

    def _find_gains(self, view: RenderedView) -> None:
        """Find the gains of all images at once."""
        if self._images is None:
            return
        looked_at = [i for i in range(len(self._visits)) if view.trains_on(i)]
        gains = log_gains(self._images, looked_at, view.draw).exp()
        self._visits[looked_at] = 1
        with torch.no_grad():
            self._values.reshape(-1, 3, 4).diagonal(dim1=1, dim2=2).copy_(
                gains - gains[looked_at].mean(0)
            )
            self._values[self._visits == 0] = 0

    def affine(self, index: int) -> Tensor:
        """Return (3, 4) the affine colour of an image: what the camera made of the scene's
        colours."""
        deviation = self._values[index].reshape(3, 4)
        return deviation + torch.eye(3, 4, dtype=deviation.dtype, device=deviation.device)

    def after_render(self, view: RenderedView) -> RenderedView:
        """Return the view with the rendering as its camera would have recorded it."""
        if view.step <= self._begins:
            return view
        if view.step == self._begins + 1:
            self._find_gains(view)
        index = view.index
        image = view.image
        background = view.background
        rendering = view.rendering
        beside = self._beside(index)
        if not int(self._visits[index]) and beside:  # was not looked at, but those next to it
            with torch.no_grad():
                self._values[index] = self._values[beside].mean(0)
        shown = recoloured(self.affine(index), image, rendering, background)
        return replace(view, rendered=up_to_white(shown, image.composite(background)))

    def __call__(self, look: Look) -> dict[str, Tensor]:
        return self.penalties(look.index)

    def penalties(self, index: int) -> dict[str, Tensor]:
        value = self._values[index]
        total = (self._weights * value.square()).mean()
        beside = self._beside(index)
        if beside:
            total = (
                total
                + SMOOTH_WEIGHT * (value - self._values[beside].detach().mean(0)).square().mean()
            )
        return {"exposure": total}

    def _beside(self, index: int) -> list[int]:
        """Return the neighbours of an image that were trained on."""
        return [i for i in self._neighbours[index] if int(self._visits[i])]

    def after_backward(self, index: int, step: int, image: Image) -> Count:
        if step <= self._begins:
            return 0
        self._visits[index] += 1
        rows = torch.zeros(len(self._visits), dtype=torch.bool, device="cpu")
        rows[index] = True
        rate = self._rates * LAST_RATE ** min(step / self._steps, 1.0)
        bad = self._adam.step_(
            "values", self._values, lr=rate, step=int(self._visits[index]), rows=rows
        )
        with torch.no_grad():
            known = self._visits > 0
            if step > self._begins + len(known):
                # all are known: what they have in common is the scene's
                self._values[known] -= self._values[known].mean(0)
        return bad

    def state(self) -> dict[str, Tensor]:
        moments = tensors_of(self._adam.state())
        return {"values": self._values.detach(), "visits": self._visits} | moments

    def load_state(self, state: dict[str, Tensor]) -> None:
        visits = require_tensor("visits", state["visits"], self._visits.shape, torch.int64)
        values = require_tensor("values", state["values"], self._values.shape, torch.float32)
        self._adam = AdamState.restored(state, {"values": values})
        self._visits, self._values = visits.clone(), values.clone().requires_grad_()


def up_to_white(rendered: Tensor, truth: Tensor) -> Tensor:
    """Return ``rendered`` (H, W, 3), at most 1 where the image is saturated: no sensor shows
    more."""
    white = truth >= SATURATED
    return torch.where(white, rendered.clamp_max(1.0), rendered) if bool(white.any()) else rendered
