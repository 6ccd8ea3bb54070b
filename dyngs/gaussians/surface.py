"""The surface that Gaussians show: their depths in many views, averaged on a grid, cut by marching
cubes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.gaussians.fusion import OPAQUE, Mesh, Seen, colours_of, fused
from dyngs.gaussians.scene import GaussianScene
from dyngs.models.surface import Surface

CELLS = 192  # Along the longest side of the box, unless asked otherwise
INNER = 0.005  # Fraction of the Gaussians on either side that does not count for where the scene is
# Around the centres: of the scene's size, and in standard deviations of a usual Gaussian
MARGIN, REACH = 0.02, 2.5
SMALLEST_PIECE = 0.02  # Faces of a piece that is kept, as a fraction of those of the largest


@torch.no_grad()
def surface_of(
    scene: GaussianScene,
    cameras: Sequence[Cameras],
    box: tuple[Tensor, Tensor],
    time: float | None = None,
    *,
    cells: int | None = None,
) -> Surface:
    """Return the surface at ``time`` that ``cameras``, one view each, see in ``box``, two corners
    (3,) in the world.

    Where nothing is seen the surface ends, and pieces with less than a fiftieth of the faces of the
    largest are left out.

    Args:
        cells: along the longest side of the box; None: ``CELLS``.

    Raises:
        DyngsError: no view shows anything solid there.
    """
    cells = CELLS if cells is None else cells
    seen = [seen_by(scene, camera, time) for camera in cameras]
    mesh = fused(seen, *box, cells, unseen_is_solid=False)
    if mesh is None:
        raise DyngsError(
            "no surface: none of the views shows anything solid where the Gaussians are"
        )
    mesh = largest_pieces(mesh)
    size = float((box[1] - box[0]).max()) / cells
    colours = colours_of(seen, torch.from_numpy(mesh.vertices).float(), 2 * size)
    return Surface(mesh.vertices, mesh.faces, colours.numpy())


def seen_by(scene: GaussianScene, camera: Cameras, time: float | None = None) -> Seen:
    """Return what one camera sees of a scene; colours are those of what is there, without the
    background."""
    options = replace(scene.options, depth="expected")
    drawn = scene.render(camera, time, options=options, background=torch.zeros(3, device="cpu"))
    assert drawn.depth is not None
    opacity = 1 - drawn.transmittance[0]
    return Seen(
        camera, drawn.depth[0], opacity, drawn.rgb[0] / opacity.clamp_min(OPAQUE)[..., None]
    )


def opaque_box(gaussians: Gaussians) -> tuple[Tensor, Tensor]:
    """Return the corners of the box around opaque Gaussians."""
    means = gaussians.means.detach()
    opaque = gaussians.logit_opacities.detach() > 0
    opaque = opaque if bool(opaque.any()) else torch.ones_like(opaque)
    low, high = (_quantile(means[opaque], fraction) for fraction in (INNER, 1 - INNER))
    usual = gaussians.log_scales.detach()[opaque].amax(1).median().exp()
    margin = MARGIN * (high - low).max() + REACH * usual
    return low - margin, high + margin


def _quantile(values: Tensor, fraction: float) -> Tensor:
    """Return the (3,) quantile of ``values`` (N, 3), any N >= 1; torch's own takes 16 million at
    most."""
    return values.sort(dim=0).values[round(fraction * (len(values) - 1))]


def largest_pieces(mesh: Mesh) -> Mesh:
    """Return the mesh without its small pieces, and without vertices that no face has."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    faces = mesh.faces
    ends = np.concatenate([faces[:, :2], faces[:, 1:]]).T
    links = coo_matrix((np.ones(ends.shape[1], np.int8), ends), shape=(len(mesh.vertices),) * 2)
    piece = connected_components(links, directed=False)[1][faces[:, 0]]
    counts = np.bincount(piece)
    faces = faces[counts[piece] >= SMALLEST_PIECE * counts.max()]
    used, joined = np.unique(faces, return_inverse=True)
    return Mesh(mesh.vertices[used], joined.reshape(-1, 3))


def num_holes(surface: Surface) -> int:
    """Return how many closed lines of edges have a face on one side only."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = np.sort(surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, counts = np.unique(edges, axis=0, return_counts=True)
    rims, ends = np.unique(edges[counts == 1], return_inverse=True)
    if not len(rims):
        return 0
    ends = ends.reshape(-1, 2).T
    links = coo_matrix((np.ones(ends.shape[1], np.int8), ends), shape=(len(rims),) * 2)
    return int(connected_components(links, directed=False)[0])
