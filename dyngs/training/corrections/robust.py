"""Robust masks: pixels that disagree with a static scene, such as passers-by, are excluded.

A large residual means that the scene is not learned yet, or that only this image shows the object.
A cell of an image is therefore masked if its residual is many times the median residual *and* other
views of that surface agree with the rendering rather than with this image.

Based on RobustNeRF (Sabour et al. 2023: residuals with spatial support) and SpotLessSplats (Sabour
et al. 2024: running histogram of residuals, warm-up without masks). These mask a fixed fraction of
pixels. The threshold and the other views used here mask almost nothing in a consistent capture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from dyngs.core.camera import Cameras
from dyngs.core.tensor_checks import require_indices, require_tensor
from dyngs.data.loader import ImageLoader
from dyngs.models.model import Correction, RenderedView
from dyngs.training.corrections.cells import (
    CELLS,
    camera_distances,
    cell_camera,
    pool_to_cells,
    project_to_pixels,
    unproject_pixels,
)

EVERY = 4  # A mask is updated on every n-th visit of its image
WARM_UP = 0.05  # Fraction of the run without masks
# Multiples of the median residual above which a cell, and a neighbour of such a cell, is masked
SEED, GROWN = 5.0, 3.0
REACH = 2  # Distance in cells within which a cell is a neighbour
SUPPORT = 0.5  # Fraction of the 3 x 3 neighbourhood that must also be masked
# Other views must differ from the rendering by less than this fraction of the image's difference
CLEARLY = 0.5
RIM = 1  # Cells by which masks are dilated
DISCOUNT = 0.95  # Decay of the residual histogram per update, a memory of about twenty updates
# The histogram spans residuals from 2 ** -12 to 1, with this many bins per factor of two
_OCTAVES, _PER_OCTAVE = 12, 16


class RobustMasks(Correction):
    """Masks of the training images, updated while they are trained on."""

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
        """Return the view with inconsistent cells removed from its mask."""
        if view.step <= self._begins:
            return view
        index = view.index
        camera = cell_camera(view.image.cameras)
        left_out = self._left_out[index, : camera.height, : camera.width]
        if int(self._visits[index]) % EVERY == 0:
            left_out.copy_(self._inconsistent_cells(view, camera))
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
            self._begins = 0.0  # masks stay active in an extended run

    @torch.no_grad()
    def _inconsistent_cells(self, view: RenderedView, camera: Cameras) -> Tensor:
        """Return (h, w) bool, the cells of a view that are excluded from the loss."""
        index = view.index
        background = view.background.cpu()
        drawn = pool_to_cells(view.rendered.detach(), camera)
        seen, keeps = self._others.cells_of(index, background)
        error = (drawn - seen).abs().mean(0)
        residual = _mean_3x3(error * keeps)
        known = residual[keeps]
        none = torch.zeros_like(keeps)
        if not known.numel():
            return none
        self._update_histogram(known)
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
        core = odd & _dilate(candidates & (residual > SEED * median), REACH)
        return _dilate(_mean_3x3(core.float()) >= SUPPORT, RIM)

    def _update_histogram(self, residual: Tensor) -> None:
        bins = (_PER_OCTAVE * (residual.clamp(2.0**-_OCTAVES, 1.0).log2() + _OCTAVES)).long()
        most = len(self._histogram)
        counts = torch.bincount(bins.clamp_max(most - 1), minlength=most)
        self._histogram = DISCOUNT * self._histogram + counts.to(self._histogram)

    def _median(self) -> float:
        """Return the median of recent residuals, as the upper end of its bin."""
        below = self._histogram.cumsum(0)
        index = int(torch.searchsorted(below, below[-1:] / 2))
        return 2.0 ** ((index + 1) / _PER_OCTAVE - _OCTAVES)


def _mean_3x3(x: Tensor) -> Tensor:
    """Return (h, w) means over the 3 x 3 neighbourhood of ``x`` (h, w)."""
    return avg_pool2d(x[None], 3, stride=1, padding=1, count_include_pad=False)[0]


def _dilate(x: Tensor, reach: int) -> Tensor:
    """Return (h, w) bool, ``x`` dilated by ``reach`` cells."""
    return max_pool2d(x.float()[None], 2 * reach + 1, stride=1, padding=reach)[0] > 0


NEAREST = 24  # Most views that a cell is compared with
FEWEST = 3  # Fewest views that must see a point
# Alpha above which rendered depth is valid, and fraction of a cell that the mask must keep
SOLID = 0.5


class NeighbourViews:
    """Mean colours of the cells of all training images, and their comparison across views.

    Args:
        correct_cameras: returns the refined camera of a view, see ``ImageLoader``. None without
            refinement.
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
        """Return the mean colours (3, h, w) of an image on ``background`` (3,), and the valid cells
        (h, w) bool."""
        cells = self._table(index)
        return cells[:3] + (1 - cells[3]) * background[:, None, None], cells[4] > SOLID

    def difference(self, index: int, which: Tensor, drawn: Tensor, background: Tensor) -> Tensor:
        """Return (P,) median colour difference between other views and the rendering.

        It is infinite where too few views see a point.

        Args:
            which: (h, w) bool, P selected cells of the image.
            drawn: (5, h, w) rendered colour, depth and alpha of the cells.
        """
        shown = drawn[:, which]
        world = unproject_pixels(self._camera(index), which.flatten().nonzero()[:, 0], shown[3])
        order = self._distance[index].argsort(stable=True)[:NEAREST]
        differences = [shown.new_full((shown.shape[1],), torch.nan)]
        for other in order[self._distance[index][order].isfinite()].tolist():
            at, _ = project_to_pixels(self._camera(other), world)
            cells = self._table(other).flatten(1)[:, at.clamp_min(0)]
            colours = cells[:3] + (1 - cells[3]) * background[:, None]
            is_seen = (at >= 0) & (cells[4] > SOLID)
            differences.append(torch.where(is_seen, (colours - shown[:3]).abs().mean(0), torch.nan))
        stacked = torch.stack(differences)
        is_known = (stacked.isfinite().sum(0) >= FEWEST) & (shown[4] > SOLID)
        return torch.where(is_known, stacked.nanmedian(0).values, torch.inf)

    def _camera(self, index: int) -> Cameras:
        camera = self._cameras[index]
        if self._corrected is None:
            return camera
        return self._corrected(index, camera).to(device="cpu")

    def _table(self, index: int) -> Tensor:
        """Return the cells (5, h, w) of an image: premultiplied colour, alpha, mask."""
        if index not in self._cells:
            image = self._images[index]
            rgb = image.rgb_premultiplied
            ones = torch.ones_like(rgb[..., 0])
            maps = [ones if x is None else x for x in (image.alpha, image.mask)]
            pixels = torch.cat([rgb, torch.stack(maps, -1)], -1)
            self._cells[index] = pool_to_cells(pixels, self._cameras[index])
        return self._cells[index]
