"""Surface extraction from Gaussians: TSDF fusion of rendered depths, and mesh simplification."""

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

MIN_OPACITY = 0.5  # opacity of a pixel from which it shows a surface


@dataclass(frozen=True)
class DepthView:
    """Rendered depth, opacity and colour of one camera."""

    camera: Cameras
    depth: Tensor  # (H, W) z
    opacity: Tensor  # (H, W)
    colour: Tensor  # (H, W, 3)


@dataclass(frozen=True)
class Mesh:
    """Triangle mesh."""

    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3)


def fuse_depths(
    seen: Sequence[DepthView],
    low: Tensor,
    high: Tensor,
    cells: int,
    *,
    unseen_is_solid: bool = True,
) -> Mesh | None:
    """Fuse depth views into a mesh in the box from ``low`` to ``high`` (3,); None if it is empty.

    Args:
        cells: along the longest side of the box.
        unseen_is_solid: unobserved space counts as inside, which closes the back of objects;
            otherwise the surface ends at the border of the observed space.
    """
    from scipy.ndimage import minimum_filter
    from skimage.measure import marching_cubes

    size = float((high - low).max()) / cells
    counts = ((high - low) / size).ceil().long() + 1
    x, y, z = (low[i] + size * torch.arange(int(counts[i]), device="cpu") for i in range(3))
    # two million points at once, to limit memory
    slabs = x.split(max((1 << 21) // (len(y) * len(z)), 1))
    means, known = zip(
        *(_signed_distances(seen, torch.cartesian_prod(slab, y, z), size) for slab in slabs),
        strict=True,
    )
    grid, is_known = (torch.cat(x).view(*counts.tolist()).numpy() for x in (means, known))
    # marching_cubes reads the mask at the last of the eight corners of a cell
    mask: np.ndarray = is_known | True if unseen_is_solid else minimum_filter(is_known, 2)
    looked_at = grid[mask]
    if not looked_at.size or not looked_at.min() < 0 < looked_at.max():
        return None
    vertices, faces, _, _ = marching_cubes(grid, 0.0, mask=mask)
    # the rows of ``faces`` have negative strides
    return Mesh(vertices * size + low.numpy(), np.ascontiguousarray(faces))


def _signed_distances(
    seen: Sequence[DepthView], points: Tensor, size: float
) -> tuple[Tensor, Tensor]:
    """Return truncated signed distances (N,) of ``points`` (N, 3) and a mask (N,) of observed
    points.

    Distances are averaged over views, positive in front of the surface, in units of three cells,
    clamped to 1; -1 for unobserved points. A view observes up to three cells behind a surface.
    """
    total = torch.zeros(len(points), device="cpu")
    weight = torch.zeros(len(points), device="cpu")
    for one in seen:
        column, row, z, inside = _project_to_pixels(one.camera, points)
        opaque = one.opacity[row, column] > MIN_OPACITY
        distance = torch.where(opaque, (one.depth[row, column] - z) / (3 * size), 1.0).clamp(max=1)
        counted = inside & (distance > -1)
        total += torch.where(counted, distance, 0.0)
        weight += counted
    return torch.where(weight > 0, total / weight.clamp_min(1), -1.0), weight > 0


def _project_to_pixels(camera: Cameras, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return columns, rows and depths of ``points`` (N, 3), and a mask of those inside the image.

    Points outside get pixel 0.
    """
    pose = camera.cam_from_world[0]
    inner = camera.intrinsics[0]
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    before = z > 0
    safe = torch.where(before, z, 1.0)
    column = (inner[0, 0] * x / safe + inner[0, 2]).floor()
    row = (inner[1, 1] * y / safe + inner[1, 2]).floor()
    inside = before & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    return torch.where(inside, column, 0).long(), torch.where(inside, row, 0).long(), z, inside


def sample_colours(seen: Sequence[DepthView], points: Tensor, tolerance: float) -> Tensor:
    """Return mean colours (N, 3) of surface ``points`` (N, 3) in the views that see them; else
    grey.

    Args:
        tolerance: distance behind the visible surface up to which a point is visible, world units.
    """
    total = torch.full((len(points), 3), 5e-4, device="cpu")
    weight = torch.full((len(points), 1), 1e-3, device="cpu")
    for one in seen:
        column, row, z, inside = _project_to_pixels(one.camera, points)
        shown = (
            inside
            & (one.opacity[row, column] > MIN_OPACITY)
            & (z < one.depth[row, column] + tolerance)
        )
        total += torch.where(shown[:, None], one.colour[row, column], 0.0)
        weight += shown[:, None]
    return total / weight


def simplify_mesh(mesh: Mesh, max_faces: int) -> Mesh:
    """Simplify a mesh to at most ``max_faces`` faces by vertex clustering."""
    if len(mesh.faces) <= max_faces:
        return mesh
    coarse = float(np.ptp(mesh.vertices, axis=0).max())
    fine = coarse / 1024
    for _ in range(10):
        size = (fine * coarse) ** 0.5
        if len(_cluster_vertices(mesh, size)[1]) <= max_faces:
            coarse = size
        else:
            fine = size
    labels, faces = _cluster_vertices(mesh, coarse)
    return Mesh(_quadric_vertices(mesh, labels, coarse), faces)


def _cluster_vertices(mesh: Mesh, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the cell (V,) of each vertex, and the distinct non-degenerate faces (F, 3) between
    cells."""
    cells = np.floor((mesh.vertices - mesh.vertices.min(0)) / size)
    labels = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    faces = labels[mesh.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return labels, faces[np.sort(first)]


def _quadric_vertices(mesh: Mesh, labels: np.ndarray, size: float) -> np.ndarray:
    """Return a vertex (L, 3) per cell that minimises the quadric error, within ``size`` of the
    mean."""
    count = int(labels.max()) + 1

    def summed(labels: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(labels, column, count) for column in values.T], 1)

    means = summed(labels, mesh.vertices) / np.bincount(labels)[:, None]
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.maximum(areas, 1e-30)
    squares = (normals[:, :, None] * normals[:, None]).reshape(-1, 9)
    left = np.zeros((count, 9))
    right = np.zeros((count, 3))
    for label in labels[mesh.faces].T:
        heights = (normals * (a - means[label])).sum(1, keepdims=True)
        left += summed(label, areas * squares)
        right += summed(label, areas * heights * normals)
    planes = left.reshape(-1, 3, 3)
    # pull towards the mean where the planes do not determine the point
    stiff = 0.02 * np.trace(planes, axis1=1, axis2=2)[:, None, None] + 1e-30
    moved = np.linalg.solve(planes + stiff * np.eye(3), right[:, :, None])[:, :, 0]
    return means + moved.clip(-size, size)


@torch.no_grad()
def extract_surface(
    scene: GaussianScene,
    cameras: Sequence[Cameras],
    box: tuple[Tensor, Tensor],
    time: float | None = None,
    *,
    cells: int | None = None,
) -> Surface:
    """Extract the surface at ``time`` from depth maps of ``cameras`` (one view each) in ``box``.

    ``box``: two corners (3,), world. The surface ends where no view observes it. Components with
    fewer than a fiftieth of the faces of the largest are dropped.

    Args:
        cells: along the longest side of the box; None: 192.

    Raises:
        DyngsError: no view shows an opaque surface in the box.
    """
    cells = cells or 192
    seen = [render_depth_view(scene, camera, time) for camera in cameras]
    mesh = fuse_depths(seen, *box, cells, unseen_is_solid=False)
    if mesh is None:
        raise DyngsError(
            "no surface found: no view shows an opaque surface in the box of the Gaussians"
        )
    mesh = keep_largest_components(mesh)
    size = float((box[1] - box[0]).max()) / cells
    colours = sample_colours(seen, torch.from_numpy(mesh.vertices).float(), 2 * size)
    return Surface(mesh.vertices, mesh.faces, colours.numpy())


def render_depth_view(
    scene: GaussianScene, camera: Cameras, time: float | None = None
) -> DepthView:
    """Render depth, opacity and colour without background for one camera."""
    options = replace(scene.options, depth="expected")
    drawn = scene.render(camera, time, options=options, background=torch.zeros(3, device="cpu"))
    assert drawn.depth is not None
    opacity = 1 - drawn.transmittance[0]
    return DepthView(
        camera, drawn.depth[0], opacity, drawn.rgb[0] / opacity.clamp_min(MIN_OPACITY)[..., None]
    )


def opaque_box(gaussians: Gaussians) -> tuple[Tensor, Tensor]:
    """Return the corners of the box of opaque Gaussians, without the outer half percent on each
    side."""
    means = gaussians.means.detach()
    opaque = gaussians.logit_opacities.detach() > 0
    opaque = opaque if bool(opaque.any()) else torch.ones_like(opaque)
    # torch.quantile takes 16 million numbers at most
    ordered = means[opaque].sort(dim=0).values
    last = len(ordered) - 1
    low, high = (ordered[round(fraction * last)] for fraction in (0.005, 0.995))
    usual = gaussians.log_scales.detach()[opaque].amax(1).median().exp()
    # Margins relative to the scene size and to the median standard deviation.
    margin = 0.02 * (high - low).max() + 2.5 * usual
    return low - margin, high + margin


def keep_largest_components(mesh: Mesh) -> Mesh:
    """Drop components with under a fiftieth of the faces of the largest, and unused vertices."""
    from trimesh.graph import connected_component_labels

    faces = mesh.faces
    edges = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    piece = connected_component_labels(edges, len(mesh.vertices))[faces[:, 0]]
    counts = np.bincount(piece)
    faces = faces[counts[piece] >= counts.max() / 50]
    used, joined = np.unique(faces, return_inverse=True)
    return Mesh(mesh.vertices[used], joined.reshape(-1, 3))


def count_holes(surface: Surface) -> int:
    """Return the number of boundary loops of a surface."""
    from trimesh import Trimesh
    from trimesh.graph import connected_components
    from trimesh.grouping import group_rows

    edges = Trimesh(surface.vertices, surface.faces, process=False).edges_sorted
    return len(connected_components(edges[group_rows(edges, require_count=1)]))
