"""Observations of a posed template in a few images, per texel: colours, visibility, silhouettes,
directions.

The images of a person become maps over the atlas (GHG, Kwon et al. 2024): each scaffold is
rasterized as a mesh into each view, and a texel counts as seen where no part of that mesh is in
front of it.

Local letters: P texels, K scaffolds.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.human.avatar.observations import FACING_EXPONENT, project_points
from dyngs.human.avatar.posing import BodyPose
from dyngs.human.body.atlas import Texels
from dyngs.human.body.mesh import interpolate, rasterize, vertex_normals
from dyngs.human.body.skinning import apply_transforms, blend_transforms, joint_transforms
from dyngs.human.predict.ghg.person import CapturedPerson, colours_nearby

_GRAZING = 0.15  # cosine below which a texel does not count as seen
HULL_LIMIT = 0.06  # largest distance from the edge of a silhouette that is told apart, m
# depth tolerance of the visibility test: in m, and in pixels along the surface
_TOLERANCE, _TOLERANCE_PX = 0.01, 1.5


@dataclass(frozen=True)
class TexelMaps:
    """Observations in a few images, per texel."""

    # (K, P, 3) mean colours, weighted towards frontal views; 0 where no view sees a texel
    rgb: Tensor
    # (K, P) largest cosine between normal and view direction, 0 where a texel is hidden
    seen: Tensor
    # (K, P) fraction of the views in whose silhouette a texel lies, of those that have it in the
    # frame
    inside: Tensor
    # (K, P) least signed distance over the views to the edge of the silhouette, positive inside, m
    # in the body's size, at most ``HULL_LIMIT`` and at least its negative
    hull: Tensor
    # (P, 3) unit vectors from one scaffold to the next in the first view's pose, relative to the
    # pelvis
    offsets: Tensor
    # (P, 3) colours of the lowest scaffold, where it is not seen those of seen texels nearby
    nearby: Tensor
    count: int  # of the views


@torch.no_grad()
def observe_texels(person: CapturedPerson, images: Iterable[tuple[Image, BodyPose]]) -> TexelMaps:
    """Return the maps of at least one image, each with its body pose. Raises ValueError: no
    image."""
    shape = (len(person.heights), len(person.texels))
    device = person.texels.points.device
    colour = torch.zeros(*shape, 3, device=device)
    weight, seen, inside, in_frames = (torch.zeros(shape, device=device) for _ in range(4))
    hull = torch.full(shape, HULL_LIMIT, device=device)
    offsets: Tensor | None = None
    count = 0
    for image, pose in images:
        distances = _edge_distances(image)
        count = count + 1
        scaffolds = [_posed_vertices(person, pose, height) for height in person.heights]
        normals = _at_texels(person, vertex_normals(scaffolds[0], person.body.faces.cpu().numpy()))
        normals = torch.nn.functional.normalize(normals, dim=1)
        if offsets is None:
            offsets = normals @ pose.rotations[0]
        for level, vertices in enumerate(scaffolds):
            view = _scaffold_view(person, image, distances, vertices, normals, float(pose.scale))
            cosine = view.cosine * (view.alpha > 0.5)
            colour[level] += cosine[:, None] ** FACING_EXPONENT * view.rgb
            weight[level] += cosine**FACING_EXPONENT * view.alpha
            seen[level] = torch.maximum(seen[level], cosine)
            inside[level] += (view.alpha > 0.5).float()
            in_frames[level] += view.in_frame
            hull[level] = torch.minimum(
                hull[level], torch.where(view.in_frame > 0, view.to_edge, HULL_LIMIT)
            )
    if offsets is None:
        raise ValueError("there must be an image")
    rgb = (colour / weight.clamp_min(1e-6)[..., None]).clamp(0, 1)
    fraction = torch.where(in_frames > 0, inside / in_frames.clamp_min(1), 1.0)
    nearby = colours_nearby(person.texels, rgb[0], seen[0])
    return TexelMaps(rgb, seen, fraction, hull.clamp_min(-HULL_LIMIT), offsets, nearby, count)


def to_atlas(values: Tensor, texels: Texels) -> Tensor:
    """Return a map (D, S, S) of ``values`` (P, D) at the texels, 0 elsewhere."""
    atlas = values.new_zeros(values.shape[1], texels.resolution**2)
    atlas[:, texels.index] = values.T
    return atlas.unflatten(1, (texels.resolution, texels.resolution))


def from_atlas(atlas: Tensor, texels: Texels) -> Tensor:
    """Return the values (P, D) of a map (D, S, S) at the texels; differentiable."""
    return atlas.flatten(1).index_select(1, texels.index).T


@dataclass(frozen=True)
class _ScaffoldView:
    """One scaffold in one view: premultiplied colour (P, 3); alpha, signed distance to the
    silhouette's edge in m of the body, cosine (0 where hidden), in the frame (P,)."""

    rgb: Tensor
    alpha: Tensor
    to_edge: Tensor
    cosine: Tensor
    in_frame: Tensor


def _scaffold_view(
    person: CapturedPerson,
    image: Image,
    distances: Tensor,
    vertices: np.ndarray,
    normals: Tensor,
    scale: float,
) -> _ScaffoldView:
    """Return one image's view of the scaffold with ``vertices`` (M, 3) and ``normals`` (P, 3).

    ``distances`` are those of ``_edge_distances``, ``scale`` is the length of a metre in world
    units.
    """
    camera = image.cameras
    world = _at_texels(person, vertices)
    at, depth, in_frame = project_points(world, camera)
    cosine = (torch.nn.functional.normalize(camera.centers[0] - world, dim=1) * normals).sum(1)
    alpha = torch.ones_like(image.rgb_premultiplied[..., 0]) if image.alpha is None else image.alpha
    planes = torch.cat([image.rgb_premultiplied, alpha[..., None], distances[..., None]], dim=-1)
    found = _sampled(planes, at) * in_frame[:, None]
    # On a slanted surface the pixels around a texel see nearer points, by their width over the
    # cosine.
    slack = scale * _TOLERANCE + _TOLERANCE_PX * depth / camera.intrinsics[
        0, 0, 0
    ] / cosine.clamp_min(_GRAZING)
    is_clear = (
        depth <= _nearest_depth(vertices, person.body.faces.cpu().numpy(), camera, at) + slack
    )
    return _ScaffoldView(
        rgb=found[:, :3],
        alpha=found[:, 3],
        to_edge=found[:, 4] * depth / camera.intrinsics[0, 0, 0] / scale,
        cosine=torch.where(is_clear & in_frame & (cosine > _GRAZING), cosine, 0.0),
        in_frame=in_frame.float(),
    )


def _edge_distances(image: Image) -> Tensor:
    """Return the signed distances (H, W) of pixels to the edge of the silhouette, positive inside,
    in pixels.

    Next to the edge they are the alpha less a half, which is exact for an upright edge.
    """
    if image.alpha is None:
        return torch.full_like(
            image.rgb_premultiplied[..., 0], float(max(image.rgb_premultiplied.shape))
        )
    alpha = image.alpha.double().cpu().numpy()
    is_inside = np.pad(alpha > 0.5, 1)
    within = np.asarray(distance_transform_edt(is_inside))[1:-1, 1:-1] - 0.5
    beyond = np.asarray(distance_transform_edt(~is_inside))[1:-1, 1:-1] - 0.5
    signed = np.where(alpha > 0.5, within, -beyond)
    signed = np.where(np.abs(signed) <= 0.5, alpha - 0.5, signed)
    return torch.from_numpy(signed).to(image.rgb_premultiplied)


def _nearest_depth(vertices: np.ndarray, faces: np.ndarray, camera: Cameras, at: Tensor) -> Tensor:
    """Return the least depth (P,) of a mesh in the four pixels around ``at`` (P, 2); infinite off
    the mesh."""
    projected, distance, _ = project_points(torch.from_numpy(vertices), camera)
    pixels = projected.double().numpy()
    depth = distance.double().numpy()
    corners = np.concatenate([pixels - 0.5, 1.0 / depth[:, None]], axis=1)[faces]
    # behind the camera: zero area, which covers nothing
    corners[(depth[faces] <= 0).any(axis=1)] = 0.0
    fragments = rasterize(corners, camera.width, camera.height)
    buffer = np.full((camera.height + 2, camera.width + 2), np.inf)
    buffer[fragments.index // camera.width + 1, fragments.index % camera.width + 1] = interpolate(
        fragments.barycentric, depth[faces[fragments.faces]][..., None]
    )[:, 0]
    least = np.minimum.reduce([buffer[:-1, :-1], buffer[1:, :-1], buffer[:-1, 1:], buffer[1:, 1:]])
    column, row = (
        (at[:, i] + 0.5).floor().nan_to_num().clamp(0, size).long()
        for i, size in enumerate((camera.width, camera.height))
    )
    return torch.from_numpy(least)[row.cpu(), column.cpu()].float().to(at.device)


def _sampled(image: Tensor, at: Tensor) -> Tensor:
    """Return values (P, D) of an image (H, W, D) at columns and rows ``at`` (P, 2), bilinear
    between pixel centres."""
    size = at.new_tensor([image.shape[1], image.shape[0]])
    grid = (2 * at / size - 1).nan_to_num().clamp(-2, 2)[None, None]
    planes = image.permute(2, 0, 1)[None]
    found = torch.nn.functional.grid_sample(
        planes, grid, padding_mode="border", align_corners=False
    )
    return found[0, :, 0].T


def _at_texels(person: CapturedPerson, values: np.ndarray) -> Tensor:
    """Return values (P, 3) at the texels, interpolated between those (M, 3) at the vertices."""
    around = (
        torch.from_numpy(values)
        .float()
        .to(person.texels.points.device)[person.body.faces[person.texels.faces]]
    )
    return (person.texels.barycentric[..., None] * around).sum(1)


def _posed_vertices(person: CapturedPerson, pose: BodyPose, height: float) -> np.ndarray:
    """Return the vertices (M, 3) of a scaffold in the world."""
    body = person.body
    vertices = body.vertices + height * person.normals
    if body.pose_dirs is not None:
        features = (pose.rotations[1:] - torch.eye(3, device=vertices.device)).flatten()
        vertices = vertices + (features @ body.pose_dirs).unflatten(0, (-1, 3))
    transforms = blend_transforms(
        body.weights, joint_transforms(body.joints, body.parents, pose.rotations)
    )
    return (pose.scale * apply_transforms(transforms, vertices) + pose.trans).cpu().numpy()
