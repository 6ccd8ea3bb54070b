"""What other views show, in coarse cells, of the places that an image shows by its rendering; gains
of images by that.

Local letters: V views, J of them asked, P places.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from dyngs.core.camera import Cameras
from dyngs.data.loader import ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.gaussians.colour.network import SATURATED
from dyngs.models.renderable import Rendering

CELLS = 40  # Cells along the longest side of an image
NEAREST = 24  # Views that are asked, at most
FEWEST = 3  # Views that must see a place, at least
SOLID = 0.5
"""Alpha from which the drawn depth means anything; and the fraction of a cell that its image's mask
must keep."""
_TINY = 1e-6


def grid_of(width: int, height: int) -> tuple[int, int]:
    """Return the rows and columns of the cells of an image."""
    longest = max(width, height)
    return max(1, round(CELLS * height / longest)), max(1, round(CELLS * width / longest))


class OtherViews:
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
        corrected: Callable[[int, Cameras], Cameras] | None = None,
    ) -> None:
        self._images, self._cameras, self._corrected = images, list(cameras), corrected
        self._poses = torch.cat([camera.cam_from_world for camera in cameras]).cpu()
        self._intrinsics = torch.cat([camera.intrinsics for camera in cameras]).cpu()
        self._sizes = torch.tensor(
            [[camera.width, camera.height] for camera in cameras], device="cpu"
        )
        self._grids = torch.tensor(
            [grid_of(camera.width, camera.height) for camera in cameras], device="cpu"
        )
        centres = torch.cat([camera.centers for camera in cameras]).cpu()
        ahead = self._poses[:, 2, :3]
        distance = torch.cdist(centres, centres, compute_mode="donot_use_mm_for_euclid_dist")
        same_side = (ahead[:, None] * ahead[None]).sum(-1) > 0
        self._distance = torch.where(same_side, distance, torch.inf).fill_diagonal_(torch.inf)
        self._cells: dict[int, Tensor] = {}

    def cells_of(self, index: int, background: Tensor) -> tuple[Tensor, Tensor]:
        """Return the (3, h, w) mean colours of an image on ``background`` (3,), and (h, w) bool
        which cells count."""
        rows, columns = self._grids[index].tolist()
        cells = self._table(index)[:, :rows, :columns]
        return cells[:3] + (1 - cells[3]) * background[:, None, None], cells[4] > SOLID

    def difference(self, index: int, which: Tensor, drawn: Tensor, background: Tensor) -> Tensor:
        """Return (P,) the median difference of other views from the rendering; infinite where too
        few see a place."""
        shown = drawn[:, which]
        others = self._asked(index)
        if not len(others) or not shown.shape[1]:
            return torch.full_like(shown[0], torch.inf)
        at, is_seen = self._found(index, which, shown[3], others)
        table = torch.stack([self._table(i) for i in others.tolist()]).flatten(2)  # (J, 5, cells)
        cells = table.gather(2, at[:, None].expand(-1, 5, -1)).transpose(1, 2)  # (J, P, 5)
        there = cells[..., :3] + (1 - cells[..., 3:4]) * background
        is_seen &= cells[..., 4] > SOLID
        differ = (
            (there - shown[:3].T)
            .abs()
            .mean(-1)
            .masked_fill(~is_seen, torch.nan)
            .nanmedian(0)
            .values
        )
        is_known = (is_seen.sum(0) >= FEWEST) & (shown[4] > SOLID)
        return torch.where(is_known, differ, torch.inf)

    def _asked(self, index: int) -> Tensor:
        """Return the (J,) indices of the nearest views that look the same way."""
        order = self._distance[index].argsort(stable=True)[:NEAREST]
        return order[self._distance[index][order].isfinite()]

    def _found(
        self, index: int, which: Tensor, depth: Tensor, others: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the (J, P) indices of the cells where other views see P cells of an image, and
        whether they do."""
        grid = self._grids[index]
        size = self._sizes[index].float()
        poses, intrinsics = self._now(torch.cat([others.new_tensor([index]), others]))
        places = which.nonzero().flip(1)  # column, row
        pixels = (places + 0.5) * (size / grid.flip(0))
        pose = poses[0]
        focal = intrinsics[0].diagonal()[:2]
        middle = intrinsics[0, :2, 2]
        local = (
            torch.cat([(pixels - middle) / focal, torch.ones_like(pixels[:, :1])], 1)
            * depth[:, None]
        )
        world = (local - pose[:3, 3]) @ pose[:3, :3]
        there = torch.einsum("jab,pb->jpa", poses[1:, :3, :3], world) + poses[1:, None, :3, 3]
        z = there[..., 2:]
        focal = intrinsics[1:].diagonal(dim1=1, dim2=2)[:, None, :2]
        middle = intrinsics[1:, None, :2, 2]
        pixels = there[..., :2] / z.clamp_min(_TINY) * focal + middle
        grids = self._grids[others].flip(1)[:, None]
        cells = (pixels / self._sizes[others, None].float() * grids).floor()
        is_seen = (z[..., 0] > _TINY) & (cells >= 0).all(-1) & (cells < grids).all(-1)
        cells = cells.clamp(torch.zeros_like(grids), grids - 1).long()
        return cells[..., 1] * CELLS + cells[..., 0], is_seen

    def _now(self, which: Tensor) -> tuple[Tensor, Tensor]:
        """Return the (J, 4, 4) poses and (J, 3, 3) intrinsics of views, corrected."""
        if self._corrected is None:
            return self._poses[which], self._intrinsics[which]
        cameras = [self._corrected(i, self._cameras[i]) for i in which.tolist()]
        parts = (
            [camera.cam_from_world for camera in cameras],
            [camera.intrinsics for camera in cameras],
        )
        poses, intrinsics = (torch.cat(part).cpu() for part in parts)
        return poses, intrinsics

    def _table(self, index: int) -> Tensor:
        """Return the (5, CELLS, CELLS) cells of an image: premultiplied colour, alpha, mask; zeros
        beyond its grid."""
        if index not in self._cells:
            image = self._images[index]
            rgb = image.rgb_premultiplied
            ones = torch.ones_like(rgb[..., 0])
            alpha, mask = (ones if x is None else x for x in (image.alpha, image.mask))
            rows, columns = self._grids[index].tolist()
            table = torch.zeros(5, CELLS, CELLS, device="cpu")
            pixels = torch.cat([rgb, alpha[..., None], mask[..., None]], -1).permute(2, 0, 1)
            table[:, :rows, :columns] = adaptive_avg_pool2d(pixels.cpu(), (rows, columns))
            self._cells[index] = table
        return self._cells[index]


# Views whose cells are the places, and nearest views that are looked for each of them
DRAWN_FROM, ASKED = 100, 40
SAME_DEPTH = 0.05  # Relative difference of depth up to which two views show the same place
OPAQUE, DARKEST = 0.9, 0.02
"""Alpha from which a cell has a depth, and mean colour from which a cell has a logarithm worth
using."""
OUTLIER = 0.1  # Residual, in log colour, at which an observation counts half as much
ROUNDS = 4
PRIOR = 0.05  # Weight of the square of a log gain, in observations: decides what no place does

Draw = Callable[[Cameras, float | None], Rendering]  # Draws cameras at a time, with expected depth


@dataclass(frozen=True)
class _Cells:
    """A view in coarse cells: its camera, log colours (C, 3), depth (C,), and which cells are known
    (C,)."""

    camera: Cameras
    colours: Tensor
    depth: Tensor
    known: Tensor


@dataclass(frozen=True)
class _Places:
    """What J views show of P places: views (J,), log colours (J, P, 3), and 1 where they show them
    (J, P)."""

    views: Tensor
    colours: Tensor
    shown: Tensor


@torch.no_grad()
def log_gains(images: ImageLoader, which: Sequence[int], draw: Draw) -> Tensor:
    """Return (V, 3) log gains of the images ``which``, of mean 0; 0 of all others.

    Each place p that view v shows has log c_vp = g_v + a_p, the log gain of the view and the log
    colour of the place, for each channel. Whoever follows the rendering view by view finds only
    what differs between neighbours: a scene that was trained on bright views of one side and dark
    ones of the other has a bright side. Least squares over all views at once (as panoramas are
    compensated; Brown and Lowe 2007) has no such error.

    Args:
        which: indices of those that may be looked at.
    """
    cells = [_cells_of(images, index, draw) for index in which]
    centres = torch.cat([x.camera.centers for x in cells]).cpu()
    distance = torch.cdist(centres, centres, compute_mode="donot_use_mm_for_euclid_dist")
    places = [
        _places(cells, i, distance[i].argsort(stable=True)[:ASKED])
        for i in evenly_spaced(len(cells), DRAWN_FROM)
    ]
    found = torch.zeros(len(cells), 3, dtype=torch.float64, device="cpu")
    for _ in range(ROUNDS):
        found = _solved(places, found)
    gains = torch.zeros(len(images), 3, device="cpu")
    gains[list(which)] = (found - found.mean(0)).float()
    return gains


def _solved(places: Sequence[_Places], gains: Tensor) -> Tensor:
    """Return (V, 3) the solution of weighted least squares, with weights from the residuals of
    ``gains``."""
    count = len(gains)
    products = PRIOR * torch.eye(count, dtype=torch.float64, device="cpu")
    sides = torch.zeros(count, 3, dtype=torch.float64, device="cpu")
    for place in places:
        weight = place.shown.double()
        seen = place.colours.double()
        even = seen - gains[place.views][:, None]
        middle = (weight[..., None] * even).sum(0) / weight.sum(0).clamp_min(1)[:, None]
        residual = (even - middle).abs().mean(-1)
        weight = weight / (1 + (residual / OUTLIER).square())
        total = weight.sum(0).clamp_min(1e-9)
        mean = (weight[..., None] * seen).sum(0) / total[:, None]
        part = torch.diag(weight.sum(1)) - (weight / total) @ weight.T
        products.index_put_((place.views[:, None], place.views[None]), part, accumulate=True)
        sides.index_put_(
            (place.views,), (weight[..., None] * (seen - mean)).sum(1), accumulate=True
        )
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
    bad = bad if image.alpha is None else bad | (image.alpha < OPAQUE)
    bad = bad if image.mask is None else bad | (image.mask < 1)
    pooled = adaptive_avg_pool2d(
        torch.cat([rgb, bad[..., None].float()], -1).permute(2, 0, 1).cpu(), (rows, columns)
    )
    colours = pooled[:3].flatten(1).T
    known = (
        (pooled[3].flatten() == 0)
        & (colours > DARKEST).all(1)
        & (drawn.alpha[0].flatten().cpu() > OPAQUE)
    )
    return _Cells(
        camera.to(device="cpu"),
        colours.clamp_min(DARKEST).log(),
        drawn.depth[0].flatten().cpu(),
        known,
    )


def _places(cells: Sequence[_Cells], index: int, asked: Tensor) -> _Places:
    """Return what the views ``asked`` show of the known cells of one view."""
    own = cells[index]
    which = own.known.nonzero()[:, 0]
    width = own.camera.width
    pixels = torch.stack([which % width, which // width], -1) + 0.5
    intrinsics = own.camera.intrinsics[0]
    pose = own.camera.cam_from_world[0]
    local = torch.cat(
        [(pixels - intrinsics[:2, 2]) / intrinsics.diagonal()[:2], torch.ones_like(pixels[:, :1])],
        1,
    )
    world = (local * own.depth[which, None] - pose[:3, 3]) @ pose[:3, :3]
    colours = []
    shown = []
    for other in (cells[i] for i in asked.tolist()):
        intrinsics = other.camera.intrinsics[0]
        pose = other.camera.cam_from_world[0]
        there = world @ pose[:3, :3].T + pose[:3, 3]
        z = there[:, 2]
        at = (
            (
                there[:, :2] / z.clamp_min(1e-6)[:, None] * intrinsics.diagonal()[:2]
                + intrinsics[:2, 2]
            )
            .floor()
            .long()
        )
        size = at.new_tensor([other.camera.width, other.camera.height])
        inside = (z > 0) & (at >= 0).all(1) & (at < size).all(1)
        cell = torch.where(inside, at[:, 1] * other.camera.width + at[:, 0], 0)
        same = (other.depth[cell] - z).abs() < SAME_DEPTH * z
        shown.append(inside & other.known[cell] & same)
        colours.append(other.colours[cell])
    return _Places(asked, torch.stack(colours), torch.stack(shown).float())
