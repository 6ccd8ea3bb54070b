"""Exposure and white balance of each training image, learned next to the scene.

A camera that chooses its exposure by itself shows the same place brighter in one image than in the
next. So each image has an affine colour, 3 x 4, that its rendering goes through before the loss, as
3DGS has since its second release. The mean over all images is the identity, so that the scene has
the colours of the mean image and not any.

Gains of all images are found at once, by the places that they share, as soon as the scene has a
depth; then Adam refines them. Adam alone is too slow for a short run, and leaves a scene bright
where bright images were taken.

Local letters: V views, J of them compared with, P places, C cells of an image, row by row, M
(V, 3, 4) deviations from the identity, matrix next to offset.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from dyngs.core.camera import Cameras
from dyngs.core.state import strip_roles
from dyngs.core.tensor_checks import require_tensor
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.gaussians.colour.network import SATURATED, apply_affine_colour
from dyngs.gaussians.optimizer import AdamState
from dyngs.models.model import Correction, Loss, LossInput, RenderedView
from dyngs.models.renderable import Rendering
from dyngs.ops.adam import Count
from dyngs.training.corrections.cells import (
    camera_distances,
    cell_camera,
    project_to_pixels,
    unproject_pixels,
)

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


class ViewExposures(Loss, Correction):
    """An affine colour per training image, and their Adam.

    Args:
        images: whose gains are found at once; None: Adam finds them.
    """

    name = "exposures"

    def __init__(self, count: int, steps: int, images: ImageLoader | None = None) -> None:
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

    @torch.no_grad()
    def _find_gains(self, images: ImageLoader, view: RenderedView) -> None:
        """Find the gains of all images at once."""
        looked_at = [i for i in range(len(self._visits)) if view.trains_on(i)]
        gains = estimate_log_gains(images, looked_at, view.draw).exp()
        self._visits[looked_at] = 1
        diagonal = self._values.reshape(-1, 3, 4).diagonal(dim1=1, dim2=2)
        diagonal.copy_(gains - gains[looked_at].mean(0))
        self._values[self._visits == 0] = 0

    def affine(self, index: int) -> Tensor:
        """Return (3, 4) the affine colour of an image: what the camera made of the scene's
        colours."""
        return self._values[index].reshape(3, 4) + torch.eye(3, 4, device="cpu")

    def after_render(self, view: RenderedView) -> RenderedView:
        """Return the view with the rendering as its camera would have recorded it."""
        if view.step <= self._begins:
            return view
        if view.step == self._begins + 1 and self._images is not None:
            self._find_gains(self._images, view)
        shown = apply_affine_colour(
            self.affine(view.index), view.image, view.rendering, view.background
        )
        # no sensor shows more than white
        white = view.image.composite(view.background) >= SATURATED
        return replace(view, rendered=torch.where(white, shown.clamp_max(1.0), shown))

    def __call__(self, look: LossInput) -> dict[str, Tensor]:
        return self.penalties(look.index)

    def penalties(self, index: int) -> dict[str, Tensor]:
        return {"exposure": (self._weights * self._values[index].square()).mean()}

    def after_backward(self, index: int, step: int, image: Image) -> Count:
        if step <= self._begins:
            return 0
        self._visits[index] += 1
        rows = torch.zeros(len(self._visits), dtype=torch.bool, device="cpu")
        rows[index] = True
        rate = self._rates * LAST_RATE ** min(step / self._steps, 1.0)
        visits = int(self._visits[index])
        bad = self._adam.step_("values", self._values, lr=rate, step=visits, rows=rows)
        known = self._visits > 0
        if step > self._begins + len(known):
            # all are known: what they have in common is the scene's
            with torch.no_grad():
                self._values[known] -= self._values[known].mean(0)
        return bad

    def state(self) -> dict[str, Tensor]:
        moments = strip_roles(self._adam.state())
        return {"values": self._values.detach(), "visits": self._visits} | moments

    def load_state(self, state: dict[str, Tensor]) -> None:
        visits = require_tensor("visits", state["visits"], self._visits.shape, torch.int64)
        values = require_tensor("values", state["values"], self._values.shape, torch.float32)
        self._adam = AdamState.from_state(state, {"values": values})
        self._visits, self._values = visits.clone(), values.clone().requires_grad_()


DRAWN_FROM = 100  # Views whose cells are the places of ``log_gains``
COMPARED = 40  # Nearest views that are compared with each of them
SAME_DEPTH = 0.05  # Relative difference of depth up to which two views show the same place
OPAQUE = 0.9  # Alpha from which a cell has a depth
DARKEST = 0.02  # Mean colour from which a cell has a logarithm worth using
OUTLIER = 0.1  # Residual, in log colour, at which an observation counts half as much
ROUNDS = 4
PRIOR = 0.05  # Weight of the square of a log gain, in observations: decides what no place does


class _Cells(NamedTuple):
    """A view in coarse cells."""

    camera: Cameras
    colours: Tensor  # (C, 3) logarithms
    depth: Tensor  # (C,)
    known: Tensor  # (C,) bool


class _Places(NamedTuple):
    """What J views show of P places."""

    views: Tensor  # (J,)
    colours: Tensor  # (J, P, 3) logarithms
    shown: Tensor  # (J, P), 1 where a view shows a place, else 0


@torch.no_grad()
def estimate_log_gains(
    images: ImageLoader, which: Sequence[int], draw: Callable[[Cameras, float | None], Rendering]
) -> Tensor:
    """Return (V, 3) log gains of the images ``which``, of mean 0; 0 of all others.

    Each place p that view v shows has log c_vp = g_v + a_p, the log gain of the view and the log
    colour of the place, for each channel. Whoever follows the rendering view by view finds only
    what differs between neighbours: a scene that was trained on bright views of one side and dark
    ones of the other has a bright side. Least squares over all views at once (as panoramas are
    compensated; Brown and Lowe 2007) has no such error.

    Args:
        which: indices of those that may be looked at.
        draw: renders the scene from cameras at a time, with expected depth.
    """
    cells = [_cells_of(images, index, draw) for index in which]
    distance = camera_distances([x.camera for x in cells])
    places = [
        _places(cells, i, distance[i].argsort(stable=True)[:COMPARED])
        for i in evenly_spaced(len(cells), DRAWN_FROM)
    ]
    found = torch.zeros(len(cells), 3, dtype=torch.float64, device="cpu")
    for _ in range(ROUNDS):
        found = _solved(places, found)
    gains = torch.zeros(len(images), 3, device="cpu")
    gains[list(which)] = (found - found.mean(0)).float()
    return gains


def _cells_of(
    images: ImageLoader, index: int, draw: Callable[[Cameras, float | None], Rendering]
) -> _Cells:
    image = images[index]
    camera = cell_camera(image.cameras)
    drawn = draw(camera, image.time)
    assert drawn.depth is not None
    rgb = image.rgb_premultiplied
    bad = (rgb >= SATURATED).any(-1)
    bad = bad if image.alpha is None else bad | (image.alpha < OPAQUE)
    bad = bad if image.mask is None else bad | (image.mask < 1)
    pixels = torch.cat([rgb, bad[..., None].float()], -1).permute(2, 0, 1).cpu()
    pooled = adaptive_avg_pool2d(pixels, (camera.height, camera.width)).flatten(1)
    colours = pooled[:3].T
    known = (pooled[3] == 0) & (colours > DARKEST).all(1)
    known &= drawn.alpha[0].flatten().cpu() > OPAQUE
    depth = drawn.depth[0].flatten().cpu()
    return _Cells(camera.to(device="cpu"), colours.clamp_min(DARKEST).log(), depth, known)


def _places(cells: Sequence[_Cells], index: int, compared: Tensor) -> _Places:
    """Return what the views ``compared`` show of the known cells of one view."""
    own = cells[index]
    which = own.known.nonzero()[:, 0]
    world = unproject_pixels(own.camera, which, own.depth[which])
    colours = []
    shown = []
    for other in (cells[i] for i in compared.tolist()):
        at, z = project_to_pixels(other.camera, world)
        cell = at.clamp_min(0)
        same = (other.depth[cell] - z).abs() < SAME_DEPTH * z
        shown.append((at >= 0) & other.known[cell] & same)
        colours.append(other.colours[cell])
    return _Places(compared, torch.stack(colours), torch.stack(shown).float())


def _solved(places: Sequence[_Places], gains: Tensor) -> Tensor:
    """Return (V, 3) the solution of weighted least squares, with weights from the residuals of
    ``gains``."""
    count = len(gains)
    products = PRIOR * torch.eye(count, dtype=torch.float64, device="cpu")
    sides = torch.zeros(count, 3, dtype=torch.float64, device="cpu")
    for views, colours, shown in places:
        weight = shown.double()
        seen = colours.double()
        even = seen - gains[views][:, None]
        middle = (weight[..., None] * even).sum(0) / weight.sum(0).clamp_min(1)[:, None]
        residual = (even - middle).abs().mean(-1)
        weight = weight / (1 + (residual / OUTLIER).square())
        total = weight.sum(0).clamp_min(1e-9)
        mean = (weight[..., None] * seen).sum(0) / total[:, None]
        part = torch.diag(weight.sum(1)) - (weight / total) @ weight.T
        side = (weight[..., None] * (seen - mean)).sum(1)
        products.index_put_((views[:, None], views[None]), part, accumulate=True)
        sides.index_put_((views,), side, accumulate=True)
    return torch.linalg.solve(products, sides)
