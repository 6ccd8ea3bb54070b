"""Training pictures that moving Gaussians are compared with: those held out, or those that they are registered with."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
from torch import Tensor

from dyngs.data.frame_selection import evenly_spaced
from dyngs.data.loader import Picture, PictureLoader
from dyngs.deform.node_shifts import SeenShift, matching_factor, seen_shift
from dyngs.gaussians import Gaussians
from dyngs.metrics import psnr
from dyngs.rendering import RenderOptions, Shader, render

MAX_VIEWS = 100
"""Pictures that are matched at once, at most."""

GaussiansAt = Callable[[float], Gaussians]
"""All Gaussians at a time, as they are drawn."""


@dataclass(frozen=True)
class ComparedViews:
    """Some of the training views.

    Attributes:
        pictures: of the training split.
        indices: of those that are compared.
        options, background, shader_at: how they are drawn; the last colours the Gaussians at a time.
    """

    pictures: PictureLoader
    indices: Sequence[int]
    options: RenderOptions
    background: Tensor
    shader_at: Callable[[float], Shader | None]

    def psnr(self, gaussians_at: GaussiansAt) -> list[float]:
        """Return the PSNR of each picture in its full size, dB."""
        shown = (self.pictures[i] for i in self.indices)
        return [psnr(self._drawn(gaussians_at(x.time or 0.0), x), x.composite(self.background), x.mask) for x in shown]

    def error(self, gaussians_at: GaussiansAt, times: tuple[float, float]) -> float:
        """Return the mean squared error of the small pictures within ``times``; 0 without any."""
        found = []
        for picture in self._seen(times):
            wrong = (
                self._drawn(gaussians_at(picture.time or 0.0), picture) - picture.composite(self.background)
            ).square()
            found.append(float(wrong.mean() if picture.mask is None else (wrong * picture.mask[..., None]).mean()))
        return fmean(found) if found else 0.0

    def shifts(self, gaussians_at: GaussiansAt, rows: Tensor, times: tuple[float, float]) -> list[SeenShift]:
        """Return how the Gaussians at ``rows`` (M,) would have to shift in each small picture within ``times``."""
        found = []
        for picture in self._seen(times):
            gaussians = gaussians_at(picture.time or 0.0).detach()
            drawn = self._drawn(gaussians, picture)
            found.append(seen_shift(gaussians, rows, picture, drawn, picture.composite(self.background)))
        return found

    def _seen(self, times: tuple[float, float]) -> Iterator[Picture]:
        known = self.pictures.times
        within = [i for i in self.indices if times[0] <= (known[i] or 0.0) <= times[1]]
        for i in (within[k] for k in evenly_spaced(len(within), MAX_VIEWS)):
            full = self.pictures[i].cameras
            yield self.pictures.shrunk(i, matching_factor(full.width, full.height))

    @torch.no_grad()
    def _drawn(self, gaussians: Gaussians, picture: Picture) -> Tensor:
        shader = self.shader_at(picture.time or 0.0)
        return render(gaussians, picture.cameras, self.options, background=self.background, shader=shader).rgb[0]
