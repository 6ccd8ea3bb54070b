"""Exposure and white balance of each training image, learned with the scene.

With automatic exposure, the same surface has different brightness in different images. The
rendering of each view is therefore transformed by an affine colour map (3, 4) before the loss, as
in later releases of 3DGS. The mean map over all images is the identity, which fixes the colours of
the scene.

Gains of all images are first estimated jointly from surfaces that several images show, as soon as
the scene has a depth. Adam then refines them. Adam alone is too slow for a short run and leaves
brightness differences in the scene.

Local letters: V views, J compared views, P points, C cells of an image in row-major order, M (V, 3,
4) deviations of colour maps from the identity.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

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
    pool_to_cells,
    project_to_pixels,
    unproject_pixels,
)

# Fraction of the run before exposures are learned: earlier renderings are too inaccurate
WARM_UP = 0.25
# Largest total change of a gain by Adam; learning rates follow from the visits per image
TRAVEL = 0.5
LAST_RATE = 0.02  # Ratio of the final to the initial learning rate, log-linear in between
MAX_RATE = 0.01
MIXING_RATE = 0.05  # Learning rate of off-diagonal entries and offsets over that of gains
# Weights of the mean squared deviation from the identity: gains vary, channels hardly mix
GAIN_WEIGHT, MIXING_WEIGHT = 0.3, 1.0


class ViewExposures(Loss, Correction):
    """An affine colour map per training image, and its Adam state.

    Args:
        count: number of training images.
        images: used to estimate all gains jointly. None leaves them to Adam.
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
    def _initialize_gains(self, images: ImageLoader, view: RenderedView) -> None:
        """Estimate the gains of all images jointly."""
        trained = [i for i in range(len(self._visits)) if view.trains_on(i)]
        gains = estimate_log_gains(images, trained, view.draw).exp()
        self._visits[trained] = 1
        diagonal = self._values.reshape(-1, 3, 4).diagonal(dim1=1, dim2=2)
        diagonal.copy_(gains - gains[trained].mean(0))
        self._values[self._visits == 0] = 0

    def affine(self, index: int) -> Tensor:
        """Return the affine colour map (3, 4) from scene colours to image ``index``."""
        return self._values[index].reshape(3, 4) + torch.eye(3, 4, device="cpu")

    def after_render(self, view: RenderedView) -> RenderedView:
        """Return the view with the colour map of its image applied to the rendering."""
        if view.step <= self._begins:
            return view
        if view.step == self._begins + 1 and self._images is not None:
            self._initialize_gains(self._images, view)
        shown = apply_affine_colour(
            self.affine(view.index), view.image, view.rendering, view.background
        )
        # Sensors saturate at white.
        white = view.image.composite(view.background) >= SATURATED
        return replace(view, rendered=torch.where(white, shown.clamp_max(1.0), shown))

    def __call__(self, look: LossInput) -> dict[str, Tensor]:
        return {"exposure": (self._weights * self._values[look.index].square()).mean()}

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
            # All images were visited: the common part belongs to the scene.
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


DRAWN_FROM = 100  # Views whose cells are the points of `estimate_log_gains`
COMPARED = 40  # Nearest views compared with each of them
SAME_DEPTH = 0.05  # Relative depth difference up to which two views show the same surface
OPAQUE = 0.9  # Alpha above which a cell has a depth
DARKEST = 0.02  # Mean colour below which the logarithm is too noisy
OUTLIER = 0.1  # Residual in log colour at which an observation has half the weight
ROUNDS = 4  # Reweighting iterations
# Weight of squared log gains, in observations: determines gains that no point constrains
PRIOR = 0.05


class _Cells(NamedTuple):
    """Coarse cells of a view."""

    camera: Cameras
    colours: Tensor  # (C, 3) logarithms
    depth: Tensor  # (C,)
    known: Tensor  # (C,) bool, valid colour and depth


class _Observations(NamedTuple):
    """Observations of P points by J views."""

    views: Tensor  # (J,)
    colours: Tensor  # (J, P, 3) logarithms
    shown: Tensor  # (J, P), 1 where a view shows a point, else 0


@torch.no_grad()
def estimate_log_gains(
    images: ImageLoader, which: Sequence[int], draw: Callable[[Cameras, float | None], Rendering]
) -> Tensor:
    """Return log gains (V, 3) of the images ``which``, with mean 0. Other images have gain 0.

    The model is log c_vp = g_v + a_p per channel, for the colour of point p in view v. All gains
    are solved jointly by robust least squares, as in panorama stitching (Brown and Lowe 2007).
    Fitting single views to the rendering would only remove differences between neighbouring views.

    Args:
        which: indices of usable images.
        draw: renders the scene from cameras at a time, with expected depth.
    """
    cells = [_view_cells(images, index, draw) for index in which]
    distance = camera_distances([x.camera for x in cells])
    observations = [
        _observe_points(cells, i, distance[i].argsort(stable=True)[:COMPARED])
        for i in evenly_spaced(len(cells), DRAWN_FROM)
    ]
    solution = torch.zeros(len(cells), 3, dtype=torch.float64, device="cpu")
    for _ in range(ROUNDS):
        solution = _solve_gains(observations, solution)
    gains = torch.zeros(len(images), 3, device="cpu")
    gains[list(which)] = (solution - solution.mean(0)).float()
    return gains


def _view_cells(
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
    pooled = pool_to_cells(torch.cat([rgb, bad[..., None].float()], -1), camera).flatten(1)
    colours = pooled[:3].T
    known = (pooled[3] == 0) & (colours > DARKEST).all(1)
    known &= drawn.alpha[0].flatten().cpu() > OPAQUE
    depth = drawn.depth[0].flatten().cpu()
    return _Cells(camera.to(device="cpu"), colours.clamp_min(DARKEST).log(), depth, known)


def _observe_points(cells: Sequence[_Cells], index: int, compared: Tensor) -> _Observations:
    """Return the observations of the known cells of one view by the views ``compared``."""
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
    return _Observations(compared, torch.stack(colours), torch.stack(shown).float())


def _solve_gains(observations: Sequence[_Observations], gains: Tensor) -> Tensor:
    """Return the gains (V, 3) by weighted least squares, reweighted by the residuals of
    ``gains``."""
    count = len(gains)
    products = PRIOR * torch.eye(count, dtype=torch.float64, device="cpu")
    sides = torch.zeros(count, 3, dtype=torch.float64, device="cpu")
    for views, colours, shown in observations:
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
