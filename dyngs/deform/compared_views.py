"""Training images that moving Gaussians are compared with: those held out, or those that they are registered with."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
from torch import Tensor

from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.deform.node_shifts import SeenShift, matching_factor, seen_shift
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, Shader, render
from dyngs.metrics import psnr

MAX_VIEWS = 100
"""Images that are matched at once, at most."""

GaussiansAt = Callable[[float], Gaussians]
"""All Gaussians at a time, as they are drawn."""


@dataclass(frozen=True)
class ComparedViews:
    """Some of the training views.

    Attributes:
        images: of the training split.
        indices: of those that are compared.
        options, background, shader_at: how they are drawn; the last colours the Gaussians at a time.
    """

    images: ImageLoader
    indices: Sequence[int]
    options: RenderOptions
    background: Tensor
    shader_at: Callable[[float], Shader | None]

    def psnr(self, gaussians_at: GaussiansAt) -> list[float]:
        """Return the PSNR of each image in its full size, dB."""
        shown = (self.images[i] for i in self.indices)
        return [psnr(self._drawn(gaussians_at(x.time or 0.0), x), x.composite(self.background), x.mask) for x in shown]

    def error(self, gaussians_at: GaussiansAt, times: tuple[float, float]) -> float:
        """Return the mean squared error of the small images within ``times``; 0 without any."""
        found = []
        for image in self._seen(times):
            wrong = (self._drawn(gaussians_at(image.time or 0.0), image) - image.composite(self.background)).square()
            found.append(float(wrong.mean() if image.mask is None else (wrong * image.mask[..., None]).mean()))
        return fmean(found) if found else 0.0

    def shifts(self, gaussians_at: GaussiansAt, rows: Tensor, times: tuple[float, float]) -> list[SeenShift]:
        """Return how the Gaussians at ``rows`` (M,) would have to shift in each small image within ``times``."""
        found = []
        for image in self._seen(times):
            gaussians = gaussians_at(image.time or 0.0).detach()
            drawn = self._drawn(gaussians, image)
            found.append(seen_shift(gaussians, rows, image, drawn, image.composite(self.background)))
        return found

    def _seen(self, times: tuple[float, float]) -> Iterator[Image]:
        known = self.images.times
        within = [i for i in self.indices if times[0] <= (known[i] or 0.0) <= times[1]]
        for i in (within[k] for k in evenly_spaced(len(within), MAX_VIEWS)):
            full = self.images[i].cameras
            yield self.images.shrunk(i, matching_factor(full.width, full.height))

    @torch.no_grad()
    def _drawn(self, gaussians: Gaussians, image: Image) -> Tensor:
        shader = self.shader_at(image.time or 0.0)
        return render(gaussians, image.cameras, self.options, background=self.background, shader=shader).rgb[0]
