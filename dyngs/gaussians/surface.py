"""The surface that Gaussians show: depths of several views averaged on a grid, and simplified."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.gaussians.scene import GaussianScene
from dyngs.models.renderable import Surface

BEHIND = 3.0  # Cells behind a surface that still count as seen
AT_ONCE = 1 << 21  # Points of the grid that are looked at together
OPAQUE = 0.5  # Of a pixel that shows a surface
TRIALS = 10  # Sizes of cells that are tried for a number of triangles
FINEST = 1024.0  # Cells along the surface, at most
# Of a vertex towards the mean of those joined, where planes do not say where they meet
STIFFNESS = 0.02


@dataclass(frozen=True)
class DepthView:
    """What one camera sees."""

    camera: Cameras
    depth: Tensor  # (H, W) z
    opacity: Tensor  # (H, W)
    colour: Tensor  # (H, W, 3)


@dataclass(frozen=True)
class Mesh:
    """Flat triangles."""

    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3)


def fused(
    seen: Sequence[DepthView],
    low: Tensor,
    high: Tensor,
    cells: int,
    *,
    unseen_is_solid: bool = True,
) -> Mesh | None:
    """Return the surface in the box from ``low`` to ``high`` (3,); None where there is none.

    Args:
        cells: along the longest side of the box.
        unseen_is_solid: what no view sees into counts as inside, which closes the back of things;
            else the surface ends where what is seen does.
    """
    from skimage.measure import marching_cubes

    size = float((high - low).max()) / cells
    counts = ((high - low) / size).ceil().long() + 1
    x, y, z = (low[i] + size * torch.arange(int(counts[i]), device="cpu") for i in range(3))
    slabs = x.split(max(AT_ONCE // (len(y) * len(z)), 1))
    means, known = zip(
        *(_averages(seen, torch.cartesian_prod(slab, y, z), size) for slab in slabs), strict=True
    )
    shape = tuple(counts.tolist())
    grid = torch.cat(means).view(shape).numpy()
    mask = None if unseen_is_solid else _known_cells(torch.cat(known).view(shape).numpy())
    looked_at = grid if mask is None else grid[mask]
    if not looked_at.size or not looked_at.min() < 0 < looked_at.max():
        return None
    vertices, faces, _, _ = marching_cubes(grid, 0.0, mask=mask)
    # its rows are stored backwards
    return Mesh(vertices * size + low.numpy(), np.ascontiguousarray(faces))


def _averages(seen: Sequence[DepthView], points: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """Return (N,) mean distances of the views that see ``points`` (N, 3), -1 without any, and (N,)
    bool: there are."""
    total = torch.zeros(len(points), device="cpu")
    weight = torch.zeros(len(points), device="cpu")
    for one in seen:
        distance, counted = _distances(one, points, size)
        total += torch.where(counted, distance, 0.0)
        weight += counted
    return torch.where(weight > 0, total / weight.clamp_min(1), -1.0), weight > 0


def _known_cells(known: np.ndarray) -> np.ndarray:
    """Return whether all eight corners of a cell are known, at its last corner, where marching
    cubes asks."""
    from scipy.ndimage import minimum_filter

    return minimum_filter(known, 2, mode="nearest")


def _distances(one: DepthView, points: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """Return (N,) signed distances before what a view shows, in cells, at most 1, and (N,) bool,
    where that counts."""
    column, row, z, inside = _pixels(one.camera, points)
    opaque = one.opacity[row, column] > OPAQUE
    before = torch.where(opaque, (one.depth[row, column] - z) / (BEHIND * size), 1.0).clamp(max=1.0)
    return before, inside & (before > -1)


def _pixels(camera: Cameras, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return columns, rows, and z of ``points`` (N, 3), and which of them lie in the image; others
    have pixel 0."""
    pose = camera.cam_from_world[0]
    inner = camera.intrinsics[0]
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    before = z > 0
    safe = torch.where(before, z, 1.0)
    column = (inner[0, 0] * x / safe + inner[0, 2]).floor()
    row = (inner[1, 1] * y / safe + inner[1, 2]).floor()
    inside = before & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    return torch.where(inside, column, 0).long(), torch.where(inside, row, 0).long(), z, inside


def colours_of(seen: Sequence[DepthView], points: Tensor, tolerance: float) -> Tensor:
    """Return (N, 3) mean colours of surface ``points`` (N, 3) in the views that show them; grey
    where none does.

    Args:
        tolerance: how far behind what a view shows a point may be, world units.
    """
    total = torch.full((len(points), 3), 5e-4, device="cpu")
    weight = torch.full((len(points), 1), 1e-3, device="cpu")
    for one in seen:
        column, row, z, inside = _pixels(one.camera, points)
        shown = (
            inside & (one.opacity[row, column] > OPAQUE) & (z < one.depth[row, column] + tolerance)
        )
        total += torch.where(shown[:, None], one.colour[row, column], 0.0)
        weight += shown[:, None]
    return total / weight


def simplified(mesh: Mesh, most: int) -> Mesh:
    """Return a mesh of about ``most`` faces, no more."""
    if len(mesh.faces) <= most:
        return mesh
    coarse = float(np.ptp(mesh.vertices, axis=0).max())
    fine = coarse / FINEST
    for _ in range(TRIALS):
        middle = (fine * coarse) ** 0.5
        if len(_joined_faces(mesh, _cells(mesh, middle))) <= most:
            coarse = middle
        else:
            fine = middle
    labels = _cells(mesh, coarse)
    return Mesh(_meeting_points(mesh, labels, coarse), _joined_faces(mesh, labels))


def _cells(mesh: Mesh, size: float) -> np.ndarray:
    """Return (V,) number of the cell that each vertex is in, of those that hold any."""
    cells = np.floor((mesh.vertices - mesh.vertices.min(0)) / size).astype(np.int64)
    _, labels = np.unique(
        (cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2], return_inverse=True
    )
    return labels.reshape(-1)


def _joined_faces(mesh: Mesh, labels: np.ndarray) -> np.ndarray:
    """Return (F, 3) faces between joined vertices, each once."""
    faces = labels[mesh.faces]
    faces = faces[
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    ]
    a, b, c = np.sort(faces, axis=1).T
    _, first = np.unique((a << 42) + (b << 21) + c, return_index=True)
    return faces[np.sort(first)]


def _meeting_points(mesh: Mesh, labels: np.ndarray, size: float) -> np.ndarray:
    """Return (L, 3): per label of vertices where the planes of their faces meet, within ``size`` of
    their mean."""
    means = _sums(labels, mesh.vertices) / _sums(labels, np.ones((len(labels), 1)))
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.maximum(areas, 1e-30)
    squares = (normals[:, :, None] * normals[:, None]).reshape(-1, 9)
    left = np.zeros((len(means), 9))
    right = np.zeros((len(means), 3))
    for corner in range(3):
        label = labels[mesh.faces[:, corner]]
        heights = (normals * (a - means[label])).sum(1, keepdims=True)
        left += _sums(label, areas * squares, len(means))
        right += _sums(label, areas * heights * normals, len(means))
    planes = left.reshape(-1, 3, 3)
    stiff = STIFFNESS * np.trace(planes, axis1=1, axis2=2)[:, None, None] + 1e-30
    moved = np.linalg.solve(planes + stiff * np.eye(3), right[:, :, None])[:, :, 0]
    return means + moved.clip(-size, size)


def _sums(labels: np.ndarray, values: np.ndarray, count: int = 0) -> np.ndarray:
    """Return (L, C) sums of ``values`` (N, C) by label; L is at least ``count``."""
    return np.stack([np.bincount(labels, column, count) for column in values.T], 1)


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


def seen_by(scene: GaussianScene, camera: Cameras, time: float | None = None) -> DepthView:
    """Return what one camera sees of a scene; colours are those of what is there, without the
    background."""
    options = replace(scene.options, depth="expected")
    drawn = scene.render(camera, time, options=options, background=torch.zeros(3, device="cpu"))
    assert drawn.depth is not None
    opacity = 1 - drawn.transmittance[0]
    return DepthView(
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
