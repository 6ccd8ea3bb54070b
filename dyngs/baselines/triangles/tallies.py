"""What images say about each triangle since triangles were last added or removed: for splitting and
pruning."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor
from torch.nn.functional import conv2d, interpolate, max_pool2d

from dyngs.baselines.triangles.scene import TriangleScene
from dyngs.core.camera import Cameras
from dyngs.core.state import Role, State, with_role
from dyngs.core.tensor_checks import require_tensor
from dyngs.ops.patches import Places

CELLS = 6  # Cells along u and v of a triangle that were seen or not (Wu et al. 2025)
FAINTEST_EDGE = 0.2  # Slopes of an image below this are no edges


class Tallies:
    """Sums over the views that were trained on since ``views`` was 0.

    Attributes:
        views: (1,) number of views.
        seen: (P,) views that show the triangle.
        edges: (P,) sum of the slopes of the images inside it.
        gradients: (P,) sum of the lengths of the gradients by its control points, over steps.
        cells: (P, 36) pixels of the images that showed each cell.
    """

    def __init__(self, count: int) -> None:
        self.views = torch.zeros(1, device="cpu")
        self.seen = torch.zeros(count, device="cpu")
        self.edges = torch.zeros(count, device="cpu")
        self.gradients = torch.zeros(count, device="cpu")
        self.cells = torch.zeros((count, CELLS**2), device="cpu")

    def tensors(self) -> dict[str, Tensor]:
        return dict(vars(self))

    def add(self, other: Tallies) -> None:
        for name, x in self.tensors().items():
            x += other.tensors()[name]

    def count(self, places: Places, slopes: Tensor) -> None:
        """Take in what a view shows, whose image has ``slopes`` (H, W)."""
        ids = places.ids.long()
        size = len(self.seen)
        shown = torch.bincount(ids, minlength=size)
        self.views += 1
        self.seen += (shown > 0).to(self.seen)
        scale = places.rows.shape[1] // slopes.shape[0]
        fine = interpolate(slopes[None, None], scale_factor=scale)[0, 0] / scale**2
        inside = fine[places.rows[0] >= 0] * ~outlines(places)
        self.edges += torch.bincount(ids, weights=inside.double(), minlength=size).to(self.edges)
        u, v = (places.uv * (CELLS - 1)).long().clamp(0, CELLS - 1).unbind(1)
        cell = (ids * CELLS + u) * CELLS + v
        self.cells += (
            torch.bincount(cell, minlength=self.cells.numel()).view_as(self.cells) / scale**2
        )

    def state(self) -> State:
        return with_role(self.tensors(), Role.TRAINING)

    @staticmethod
    def restored(stored: Mapping[str, Tensor], count: int) -> Tallies:
        """Return the tallies of ``count`` triangles in a state. Raises KeyError or ValueError."""
        found = Tallies(count)
        for name, x in found.tensors().items():
            x.copy_(require_tensor(name, stored[name], tuple(x.shape)))
        return found


@torch.no_grad()
def most_pixels(scene: TriangleScene, cameras: Iterable[Cameras]) -> Tensor:
    """Return (P,) the pixels that each triangle has in the view of ``cameras``, one each, that
    shows most of it."""
    most = torch.zeros(len(scene), device="cpu")
    for camera in cameras:
        ids = scene.view(camera, scene.options).places.ids.long()
        shown = torch.bincount(ids, minlength=len(scene)) / scene.options.supersampling**2
        most = torch.maximum(most, shown)
    return most


def outlines(places: Places) -> Tensor:
    """Return (N,) bool: which places lie within two drawn pixels of an outline, see
    ``blend_patches``."""
    rows = places.rows[0]
    drawn = rows >= 0
    ids = torch.full(rows.shape, -1, dtype=places.ids.dtype, device="cpu")
    ids[drawn] = places.ids[rows[drawn].long()]
    differs = torch.zeros(rows.shape, device="cpu")
    differs[:, :-1] += ids[:, 1:] != ids[:, :-1]
    differs[:-1] += ids[1:] != ids[:-1]
    return max_pool2d(differs[None, None], 3, 1, 1)[0, 0][drawn] > 0


def slopes_of(image: Tensor) -> Tensor:
    """Return (H, W): mean size of the slopes of ``image`` (H, W, 3) by Prewitt's operator; faint
    ones are 0."""
    across = torch.tensor([[-1.0, 0, 1]] * 3, device="cpu") / 3
    kernels = torch.stack([across, across.T])[:, None]
    channels = torch.nn.functional.pad(
        image.permute(2, 0, 1)[:, None], (1, 1, 1, 1), mode="replicate"
    )
    sizes = conv2d(channels, kernels).square().sum(1).sqrt()
    return torch.where(sizes < FAINTEST_EDGE, 0.0, sizes).mean(0)
