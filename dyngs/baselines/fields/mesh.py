"""The surface of a field: where its density is of a level, by marching cubes (Lorensen and Cline
1987)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dyngs.baselines.fields.field import PUBLISHED_HALF
from dyngs.baselines.fields.scene import FieldScene
from dyngs.core.errors import DyngsError
from dyngs.models.surface import Surface

CELLS = 192  # Along an axis of the innermost cube, unless asked otherwise
LEVEL = 25.0
"""Density at the surface, unless asked otherwise, per unit of a world whose innermost cube has half
side 1.5: half of the light is lost in a 36th of a unit."""
CHUNK = 1 << 17  # Points looked at together


@torch.no_grad()
def surface_of(
    scene: FieldScene, time: float = 0.0, level: float | None = None, cells: int | None = None
) -> Surface:
    """Return the surface in the innermost cube at ``time``.

    Args:
        level: density there, per unit of a world whose innermost cube has half side 1.5; None:
            ``LEVEL``.
        cells: along an axis of the cube; None: ``CELLS``.

    Raises:
        DyngsError: the density is nowhere, or everywhere, of that level.
    """
    from skimage.measure import marching_cubes

    level = LEVEL if level is None else level
    cells = CELLS if cells is None else cells
    space = scene.field.space
    grid = _densities(scene, time, cells) * (space.half / PUBLISHED_HALF)
    if not float(grid.min()) < level < float(grid.max()):
        raise DyngsError(
            f"no surface: densities are from {float(grid.min()):.3g} to {float(grid.max()):.3g}, none of them "
            f"{level:g}; give another --level"
        )
    # x is the first axis of the grid; a logarithm, because density rises by orders of magnitude
    # within a cell
    found = marching_cubes(
        np.log(np.maximum(grid.numpy(), 1e-6)), np.log(level), gradient_direction="ascent"
    )
    places = found[0]
    faces = found[1]
    normals = found[2]
    vertices = torch.from_numpy(places.copy()) * (2 * space.half / cells) + (
        torch.tensor(space.centre, device="cpu") - space.half
    )
    inwards = torch.nn.functional.normalize(torch.from_numpy(-normals.copy()), dim=1)
    colours = [
        scene.field.colours(x, d, time)
        for x, d in zip(vertices.split(CHUNK), inwards.split(CHUNK), strict=True)
    ]
    return Surface(vertices.numpy(), faces, torch.cat(colours).numpy())


def _densities(scene: FieldScene, time: float, cells: int) -> Tensor:
    """Return densities, per world unit, at (cells + 1)^3 places, x the first axis; 0 on the sides
    of the cube."""
    space = scene.field.space
    axis = torch.linspace(-space.half, space.half, cells + 1, device="cpu")
    x, y, z = torch.meshgrid(*(axis + middle for middle in space.centre), indexing="ij")
    points = torch.stack([x, y, z], -1).view(-1, 3)
    found = torch.zeros(len(points), device="cpu")
    for which in scene.field.may_hold(points).nonzero()[:, 0].split(CHUNK):
        found[which] = scene.field.densities(points[which], time)
    found = found.view(x.shape)
    inner = torch.zeros_like(found)
    inner[1:-1, 1:-1, 1:-1] = found[1:-1, 1:-1, 1:-1]
    return inner
