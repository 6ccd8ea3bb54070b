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

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, max_pool2d

from dyngs.core.camera import Cameras
from dyngs.core.tensor_checks import require_indices, require_tensor
from dyngs.data.loader import ImageLoader
from dyngs.models.model import Correction, RenderedView
from dyngs.training.corrections.cells import (
    CELLS,
    camera_distances,
    cell_camera,
    project_to_pixels,
    unproject_pixels,
)

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
        correct_cameras: Callable[[int, Cameras], Cameras] | None = None,
    ) -> None:
        self._others = NeighbourViews(images, cameras, correct_cameras)
        self._begins = WARM_UP * steps
        self._visits = torch.zeros(len(images), dtype=torch.int64, device="cpu")
        self._left_out = torch.zeros(len(images), CELLS, CELLS, dtype=torch.uint8, device="cpu")
        self._histogram = torch.zeros(_OCTAVES * _PER_OCTAVE, dtype=torch.float64, device="cpu")

    def after_render(self, view: RenderedView) -> RenderedView:
        """Return the view with a mask of the pixels that agree with the other views."""
        if view.step <= self._begins:
            return view
        index = view.index
        camera = cell_camera(view.image.cameras)
        left_out = self._left_out[index, : camera.height, : camera.width]
        if int(self._visits[index]) % EVERY == 0:
            left_out.copy_(self._disagreeing(view, camera))
        self._visits[index] += 1
        if not bool(left_out.any()):
            return view
        image = view.image
        height, width = image.rgb_premultiplied.shape[:2]
        at_rows = torch.arange(height, device="cpu") * camera.height // height
        at_columns = torch.arange(width, device="cpu") * camera.width // width
        counts = (1.0 - left_out.float())[at_rows][:, at_columns].to(image.rgb_premultiplied)
        mask = counts if image.mask is None else counts * image.mask
        return replace(view, image=replace(image, mask=mask))

    def state(self) -> dict[str, Tensor]:
        return {"visits": self._visits, "left_out": self._left_out, "histogram": self._histogram}

    def load_state(self, state: dict[str, Tensor]) -> None:
        visits = require_tensor("visits", state["visits"], self._visits.shape, torch.int64)
        shape = tuple(self._left_out.shape)
        left_out = require_indices("left_out", state["left_out"], shape, 2, torch.uint8)
        shape = self._histogram.shape
        histogram = require_tensor("histogram", state["histogram"], shape, torch.float64)
        self._visits = visits.clone()
        self._left_out = left_out.clone()
        self._histogram = histogram.clone()
        if bool(visits.any()):
            self._begins = 0.0  # also where the run has become longer

    @torch.no_grad()
    def _disagreeing(self, view: RenderedView, camera: Cameras) -> Tensor:
        """Return (h, w) bool: the cells of a view, the pixels of ``camera``, that count no more."""
        index = view.index
        background = view.background.cpu()
        size = (camera.height, camera.width)
        drawn = adaptive_avg_pool2d(view.rendered.detach().cpu().permute(2, 0, 1), size)
        seen, keeps = self._others.cells_of(index, background)
        error = (drawn - seen).abs().mean(0)
        residual = _around(error * keeps)
        known = residual[keeps]
        none = torch.zeros_like(keeps)
        if not known.numel():
            return none
        self._remember(known)
        median = max(self._median(), float(known.median()))
        candidates = (residual > GROWN * median) & keeps
        if not bool((residual[candidates] > SEED * median).any()):
            return none
        coarse = view.draw(camera, view.image.time)
        assert coarse.depth is not None
        shown = torch.cat([drawn, coarse.depth.cpu(), coarse.alpha.cpu()])
        others = self._others.difference(index, candidates, shown, background)
        odd = candidates.clone()
        odd[candidates] = others < CLEARLY * error[candidates]
        core = odd & _near(candidates & (residual > SEED * median), REACH)
        return _near(_around(core.float()) >= SUPPORT, RIM)

    def _remember(self, residual: Tensor) -> None:
        bins = (_PER_OCTAVE * (residual.clamp(2.0**-_OCTAVES, 1.0).log2() + _OCTAVES)).long()
        most = len(self._histogram)
        counts = torch.bincount(bins.clamp_max(most - 1), minlength=most)
        self._histogram = DISCOUNT * self._histogram + counts.to(self._histogram)

    def _median(self) -> float:
        """Return the median residual of the last looks, the upper end of its bin."""
        below = self._histogram.cumsum(0)
        index = int(torch.searchsorted(below, below[-1:] / 2))
        return 2.0 ** ((index + 1) / _PER_OCTAVE - _OCTAVES)


def _around(x: Tensor) -> Tensor:
    """Return (h, w) the means of the cells of ``x`` (h, w) and those next to them."""
    return avg_pool2d(x[None], 3, stride=1, padding=1, count_include_pad=False)[0]


def _near(x: Tensor, reach: int) -> Tensor:
    """Return (h, w) whether one of the cells up to ``reach`` away is true in ``x`` (h, w) bool."""
    return max_pool2d(x.float()[None], 2 * reach + 1, stride=1, padding=reach)[0] > 0


NEAREST = 24  # Views that are compared with, at most
FEWEST = 3  # Views that must see a place, at least
# Alpha from which the drawn depth means anything; and the fraction of a cell that its image's mask
# must keep
SOLID = 0.5


class NeighbourViews:
    """Mean colours of the cells of all training images, and where cells of one are found in the
    others.

    Args:
        corrected: returns the camera of a view as it is by now, see ``ImageLoader``; None: it
            stays.
    """

    def __init__(
        self,
        images: ImageLoader,
        cameras: Sequence[Cameras],
        correct_cameras: Callable[[int, Cameras], Cameras] | None = None,
    ) -> None:
        self._images = images
        self._cameras = [cell_camera(camera.to(device="cpu")) for camera in cameras]
        self._corrected = correct_cameras
        ahead = torch.cat([camera.cam_from_world for camera in self._cameras])[:, 2, :3]
        same_side = (ahead[:, None] * ahead).sum(-1) > 0
        distance = torch.where(same_side, camera_distances(self._cameras), torch.inf)
        self._distance = distance.fill_diagonal_(torch.inf)
        self._cells: dict[int, Tensor] = {}

    def cells_of(self, index: int, background: Tensor) -> tuple[Tensor, Tensor]:
        """Return the (3, h, w) mean colours of an image on ``background`` (3,), and (h, w) bool
        which cells count."""
        cells = self._table(index)
        return cells[:3] + (1 - cells[3]) * background[:, None, None], cells[4] > SOLID

    def difference(self, index: int, which: Tensor, drawn: Tensor, background: Tensor) -> Tensor:
        """Return (P,) the median difference of other views from the rendering; infinite where too
        few see a place.

        Args:
            which: (h, w) bool, P of the cells of the image.
            drawn: (5, h, w) rendered colour, depth and alpha of the cells.
        """
        shown = drawn[:, which]
        world = unproject_pixels(self._camera(index), which.flatten().nonzero()[:, 0], shown[3])
        order = self._distance[index].argsort(stable=True)[:NEAREST]
        found = [shown.new_full((shown.shape[1],), torch.nan)]
        for other in order[self._distance[index][order].isfinite()].tolist():
            at, _ = project_to_pixels(self._camera(other), world)
            cells = self._table(other).flatten(1)[:, at.clamp_min(0)]
            colours = cells[:3] + (1 - cells[3]) * background[:, None]
            is_seen = (at >= 0) & (cells[4] > SOLID)
            found.append(torch.where(is_seen, (colours - shown[:3]).abs().mean(0), torch.nan))
        differences = torch.stack(found)
        is_known = (differences.isfinite().sum(0) >= FEWEST) & (shown[4] > SOLID)
        return torch.where(is_known, differences.nanmedian(0).values, torch.inf)

    def _camera(self, index: int) -> Cameras:
        camera = self._cameras[index]
        if self._corrected is None:
            return camera
        return self._corrected(index, camera).to(device="cpu")

    def _table(self, index: int) -> Tensor:
        """Return the (5, h, w) cells of an image: premultiplied colour, alpha, mask."""
        if index not in self._cells:
            image = self._images[index]
            rgb = image.rgb_premultiplied
            ones = torch.ones_like(rgb[..., 0])
            maps = [ones if x is None else x for x in (image.alpha, image.mask)]
            pixels = torch.cat([rgb, torch.stack(maps, -1)], -1).permute(2, 0, 1).cpu()
            camera = self._cameras[index]
            self._cells[index] = adaptive_avg_pool2d(pixels, (camera.height, camera.width))
        return self._cells[index]
