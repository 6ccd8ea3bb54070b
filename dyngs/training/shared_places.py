"""Gains of images from the places that several of them show, solved for all at once.

Each place p that view v shows has log c_vp = g_v + a_p, the log gain of the view and the log colour of the place, for
each channel. Whoever follows the rendering view by view finds only what differs between neighbours: a scene that was
trained on bright views of one side and dark ones of the other has a bright side. Least squares over all views at once
(as panoramas are compensated; Brown and Lowe 2007) has no such error. Where the places are says the depth of the scene,
drawn in coarse cells.

Local letters: V views, J of them asked, P places.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from dyngs.camera import Cameras
from dyngs.data.loader import ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.gaussians.colour.affine import SATURATED
from dyngs.models.renderable import Rendering
from dyngs.training.other_views import grid_of

DRAWN_FROM, ASKED = 100, 40  # Views whose cells are the places, and nearest views that are looked for each of them
SAME_DEPTH = 0.05  # Relative difference of depth up to which two views show the same place
SOLID, DARK = 0.9, 0.02
"""Alpha from which a cell has a depth, and mean colour from which a cell has a logarithm worth using."""
OUTLIER = 0.1  # Residual, in log colour, at which an observation counts half as much
ROUNDS = 4
PRIOR = 0.05  # Weight of the square of a log gain, in observations: decides what no place does

Draw = Callable[[Cameras, float | None], Rendering]  # Draws cameras at a time, with expected depth


@dataclass(frozen=True)
class _Cells:
    """A view in coarse cells: its camera, log colours (C, 3), depth (C,), and which cells are known (C,)."""

    camera: Cameras
    colours: Tensor
    depth: Tensor
    known: Tensor


@dataclass(frozen=True)
class _Places:
    """What J views show of P places: views (J,), log colours (J, P, 3), and 1 where they show them (J, P)."""

    views: Tensor
    colours: Tensor
    shown: Tensor


@torch.no_grad()
def log_gains(images: ImageLoader, which: Sequence[int], draw: Draw) -> Tensor:
    """Return (V, 3) log gains of the images ``which``, of mean 0; 0 of all others.

    Args:
        which: indices of those that may be looked at.
    """
    cells = [_cells_of(images, index, draw) for index in which]
    centres = torch.cat([x.camera.centers for x in cells]).cpu()
    distance = torch.cdist(centres, centres, compute_mode="donot_use_mm_for_euclid_dist")
    places = [
        _places(cells, i, distance[i].argsort(stable=True)[:ASKED]) for i in evenly_spaced(len(cells), DRAWN_FROM)
    ]
    found = torch.zeros(len(cells), 3, dtype=torch.float64, device="cpu")
    for _ in range(ROUNDS):
        found = _solved(places, found)
    gains = torch.zeros(len(images), 3, device="cpu")
    gains[list(which)] = (found - found.mean(0)).float()
    return gains


def _solved(places: Sequence[_Places], gains: Tensor) -> Tensor:
    """Return (V, 3) the solution of weighted least squares, with weights from the residuals of ``gains``."""
    count = len(gains)
    products = PRIOR * torch.eye(count, dtype=torch.float64, device="cpu")
    sides = torch.zeros(count, 3, dtype=torch.float64, device="cpu")
    for place in places:
        weight, seen = place.shown.double(), place.colours.double()
        even = seen - gains[place.views][:, None]
        middle = (weight[..., None] * even).sum(0) / weight.sum(0).clamp_min(1)[:, None]
        residual = (even - middle).abs().mean(-1)
        weight = weight / (1 + (residual / OUTLIER).square())
        total = weight.sum(0).clamp_min(1e-9)
        mean = (weight[..., None] * seen).sum(0) / total[:, None]
        part = torch.diag(weight.sum(1)) - (weight / total) @ weight.T
        products.index_put_((place.views[:, None], place.views[None]), part, accumulate=True)
        sides.index_put_((place.views,), (weight[..., None] * (seen - mean)).sum(1), accumulate=True)
    return torch.linalg.solve(products, sides)


def _cells_of(images: ImageLoader, index: int, draw: Draw) -> _Cells:
    image = images[index]
    old = image.cameras
    rows, columns = grid_of(old.width, old.height)
    scale = old.intrinsics.new_tensor([columns / old.width, rows / old.height, 1.0])
    camera = Cameras(old.cam_from_world, scale[:, None] * old.intrinsics, columns, rows)
    drawn = draw(camera, image.time)
    assert drawn.depth is not None
    rgb = image.rgb_premultiplied
    bad = (rgb >= SATURATED).any(-1)
    bad = bad if image.alpha is None else bad | (image.alpha < SOLID)
    bad = bad if image.mask is None else bad | (image.mask < 1)
    pooled = adaptive_avg_pool2d(torch.cat([rgb, bad[..., None].float()], -1).permute(2, 0, 1).cpu(), (rows, columns))
    colours = pooled[:3].flatten(1).T
    known = (pooled[3].flatten() == 0) & (colours > DARK).all(1) & (drawn.alpha[0].flatten().cpu() > SOLID)
    return _Cells(camera.to(device="cpu"), colours.clamp_min(DARK).log(), drawn.depth[0].flatten().cpu(), known)


def _places(cells: Sequence[_Cells], index: int, asked: Tensor) -> _Places:
    """Return what the views ``asked`` show of the known cells of one view."""
    own = cells[index]
    which = own.known.nonzero()[:, 0]
    width = own.camera.width
    pixels = torch.stack([which % width, which // width], -1) + 0.5
    intrinsics, pose = own.camera.intrinsics[0], own.camera.cam_from_world[0]
    local = torch.cat([(pixels - intrinsics[:2, 2]) / intrinsics.diagonal()[:2], torch.ones_like(pixels[:, :1])], 1)
    world = (local * own.depth[which, None] - pose[:3, 3]) @ pose[:3, :3]
    colours, shown = [], []
    for other in (cells[i] for i in asked.tolist()):
        intrinsics, pose = other.camera.intrinsics[0], other.camera.cam_from_world[0]
        there = world @ pose[:3, :3].T + pose[:3, 3]
        z = there[:, 2]
        at = (there[:, :2] / z.clamp_min(1e-6)[:, None] * intrinsics.diagonal()[:2] + intrinsics[:2, 2]).floor().long()
        size = at.new_tensor([other.camera.width, other.camera.height])
        inside = (z > 0) & (at >= 0).all(1) & (at < size).all(1)
        cell = torch.where(inside, at[:, 1] * other.camera.width + at[:, 0], 0)
        same = (other.depth[cell] - z).abs() < SAME_DEPTH * z
        shown.append(inside & other.known[cell] & same)
        colours.append(other.colours[cell])
    return _Places(asked, torch.stack(colours), torch.stack(shown).float())
