"""Masks of what disagrees with a static scene, found in training: people who walk through, for
instance.

Where an image differs from its rendering, either the scene is not learned yet, or the image shows
something that the other images do not. So cells of an image count no more where the residual is
many times the median of the last views, *and* other views of that place look like the rendering
rather than like this image.

After RobustNeRF (Sabour et al. 2023: residuals with spatial support) and SpotLessSplats (Sabour et
al. 2024: a running histogram of residuals, a warm-up without masks). There a fixed fraction of the
pixels is left out; here a multiple of the median decides, and the other views, so that hardly
anything is where they agree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, max_pool2d

from dyngs.core.camera import Cameras
from dyngs.core.tensor_checks import require_indices, require_tensor
from dyngs.data.loader import ImageLoader
from dyngs.models.model import Correction, RenderedView
from dyngs.training.other_views import CELLS, OtherViews, grid_of

# An image is looked at each so many times that it is trained on; in between its mask stays
EVERY = 4
WARM_UP = 0.05  # Fraction of the run in which everything counts
SEED, GROWN = 5.0, 3.0
"""Multiples of the median residual: from the first a cell is left out, from the second next to such
cells."""
REACH = 2  # Cells up to which a cell counts as next to another
SUPPORT = 0.5  # Fraction of the 3 x 3 cells around that must be left out, too
CLEARLY = 0.5
"""A place disagrees where the other views differ from the rendering by less than this fraction of
what it does."""
RIM = 1  # Cells around what is left out that are left out with it
DISCOUNT = 0.95
"""Weight of the histogram of all looks before against that of the present one: it remembers about
twenty."""
# The histogram spans residuals from 2 ** -12 to 1, so many bins for each factor of two
_OCTAVES, _PER_OCTAVE = 12, 16


class RobustMasks(Correction):
    """Masks of the pixels that count, one per training image, brought up to date as it is trained
    on."""

    name = "robust"

    def __init__(
        self,
        images: ImageLoader,
        cameras: list[Cameras],
        steps: int,
        corrected: Callable[[int, Cameras], Cameras] | None = None,
    ) -> None:
        self._others = OtherViews(images, cameras, corrected)
        self._begins = WARM_UP * steps
        self._visits = torch.zeros(len(images), dtype=torch.int64, device="cpu")
        self._left_out = torch.zeros(len(images), CELLS, CELLS, dtype=torch.uint8, device="cpu")
        self._histogram = torch.zeros(_OCTAVES * _PER_OCTAVE, dtype=torch.float64, device="cpu")

    def after_render(self, view: RenderedView) -> RenderedView:
        """Return the view with a mask of the pixels that agree with the other views."""
        if view.step <= self._begins:
            return view
        index = view.index
        if int(self._visits[index]) % EVERY == 0:
            self._look(view)
        self._visits[index] += 1
        image = view.image
        height, width = image.rgb_premultiplied.shape[:2]
        rows, columns = grid_of(width, height)
        left_out = self._left_out[index, :rows, :columns]
        if not bool(left_out.any()):
            return view
        at_rows = torch.arange(height, device="cpu") * rows // height
        at_columns = torch.arange(width, device="cpu") * columns // width
        counts = (1.0 - left_out.float())[at_rows][:, at_columns].to(image.rgb_premultiplied)
        mask = counts if image.mask is None else counts * image.mask
        return replace(view, image=replace(image, mask=mask))

    def state(self) -> dict[str, Tensor]:
        return {"visits": self._visits, "left_out": self._left_out, "histogram": self._histogram}

    def load_state(self, state: dict[str, Tensor]) -> None:
        count = len(self._visits)
        visits = require_tensor("visits", state["visits"], (count,), torch.int64)
        left_out = require_indices(
            "left_out", state["left_out"], (count, CELLS, CELLS), 2, torch.uint8
        )
        histogram = require_tensor(
            "histogram", state["histogram"], self._histogram.shape, torch.float64
        )
        self._visits, self._left_out, self._histogram = (
            visits.clone(),
            left_out.clone(),
            histogram.clone(),
        )
        if bool(visits.any()):
            self._begins = 0.0  # also where the run has become longer

    @torch.no_grad()
    def _look(self, view: RenderedView) -> None:
        index = view.index
        cameras = view.image.cameras
        background = view.background.cpu()
        grid = grid_of(cameras.width, cameras.height)
        drawn = adaptive_avg_pool2d(view.rendered.detach().cpu().permute(2, 0, 1), grid)
        seen, keeps = self._others.cells_of(index, background)
        residual = (drawn - seen).abs().mean(0, keepdim=True)
        residual = avg_pool2d(residual * keeps, 3, stride=1, padding=1, count_include_pad=False)[0]
        known = residual[keeps]
        if not known.numel():
            return
        self._remember(known)
        median = max(self._median(), float(known.median()))
        candidates = (residual > GROWN * median) & keeps
        if not bool((residual[candidates] > SEED * median).any()):
            self._left_out[index] = 0
            return
        coarse = view.draw(_as_cells(cameras, grid), view.image.time)
        assert coarse.depth is not None
        shown = torch.cat([drawn, coarse.depth.cpu(), coarse.alpha.cpu()])
        others = self._others.difference(index, candidates, shown, background)
        odd = candidates.clone()
        odd[candidates] = others < CLEARLY * (drawn - seen).abs().mean(0)[candidates]
        core = odd & _near(candidates & (residual > SEED * median), REACH)
        core = (
            avg_pool2d(core.float()[None], 3, stride=1, padding=1, count_include_pad=False)[0]
            >= SUPPORT
        )
        self._left_out[index, : grid[0], : grid[1]] = _near(core, RIM).to(torch.uint8)

    def _remember(self, residual: Tensor) -> None:
        bins = (_PER_OCTAVE * (residual.clamp(2.0**-_OCTAVES, 1.0).log2() + _OCTAVES)).long()
        counts = torch.bincount(
            bins.clamp_max(len(self._histogram) - 1), minlength=len(self._histogram)
        )
        self._histogram = DISCOUNT * self._histogram + counts.to(self._histogram)

    def _median(self) -> float:
        """Return the median residual of the last looks, the upper end of its bin."""
        below = self._histogram.cumsum(0)
        index = int(torch.searchsorted(below, below[-1:] / 2))
        return 2.0 ** ((index + 1) / _PER_OCTAVE - _OCTAVES)


def _as_cells(cameras: Cameras, grid: tuple[int, int]) -> Cameras:
    scale = cameras.intrinsics.new_tensor([grid[1] / cameras.width, grid[0] / cameras.height, 1.0])
    return Cameras(cameras.cam_from_world, scale[:, None] * cameras.intrinsics, grid[1], grid[0])


def _near(x: Tensor, reach: int) -> Tensor:
    """Return (h, w) whether one of the cells up to ``reach`` away is true in ``x`` (h, w) bool."""
    return max_pool2d(x.float()[None], 2 * reach + 1, stride=1, padding=reach)[0] > 0
