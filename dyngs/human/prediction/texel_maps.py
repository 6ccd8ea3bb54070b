"""What a few pictures show of a posed template, texel by texel: colours, who sees what, silhouettes, where it points.

The pictures of a person become maps over the atlas (GHG, Kwon et al. 2024): each scaffold is drawn as a mesh into each
view, and a texel counts as seen where nothing of that mesh is in front of it.

Local letters: P texels, K scaffolds, M vertices.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.data.loader import Picture
from dyngs.human.avatar.posing import BodyPose
from dyngs.human.pose.skinning import apply_transforms, blend_transforms, joint_transforms
from dyngs.human.prediction.person import CapturedPerson
from dyngs.human.template.atlas import Texels
from dyngs.human.template.mesh import interpolate, rasterize, vertex_normals

_FACING = 4
"""Power of the cosine between normal and view that weights colours: who sees a place head-on, sees it truly."""

_GRAZING = 0.15
"""Cosine below which a texel does not count as seen."""

_SLACK, _SLANT = 0.01, 1.5
"""How much nearer than a texel its own surface may appear to be: in m, and in pixels along the surface."""


@dataclass(frozen=True)
class TexelMaps:
    """What pictures show, per texel.

    Attributes:
        rgb: (K, P, 3) colours that the views see, weighted by how well; 0 where none does.
        seen: (K, P) the cosine at which the best view sees a texel of a scaffold, 0 where it is hidden.
        inside: (K, P) share of the views in whose silhouette it lies.
        offsets: (P, 3) unit vectors from one scaffold to the next in the first view's pose, relative to the pelvis.
    """

    rgb: Tensor
    seen: Tensor
    inside: Tensor
    offsets: Tensor


@torch.no_grad()
def observe_texels(sitter: CapturedPerson, shown: Iterable[tuple[Picture, BodyPose]]) -> TexelMaps:
    """What the pictures, each with its pose, show of the person: at least one."""
    levels, count = len(sitter.heights), len(sitter.texels)
    colour, weight = torch.zeros(levels, count, 3), torch.zeros(levels, count)
    seen, inside, looked = (torch.zeros(levels, count) for _ in range(3))
    offsets: Tensor | None = None
    for picture, posing in shown:
        scaffolds = [_posed(sitter, posing, height) for height in sitter.heights]
        normals = _at_texels(sitter, vertex_normals(scaffolds[0], sitter.body.faces.numpy()))
        normals = torch.nn.functional.normalize(normals, dim=1)
        if offsets is None:
            offsets = normals @ posing.rotations[0]
        for level, vertices in enumerate(scaffolds):
            sight = _sight(sitter, picture, vertices, normals, float(posing.scale))
            cosine = sight.cosine * (sight.alpha > 0.5)
            colour[level] += cosine[:, None] ** _FACING * sight.rgb
            weight[level] += cosine**_FACING * sight.alpha
            seen[level] = torch.maximum(seen[level], cosine)
            inside[level] += (sight.alpha > 0.5).float()
            looked[level] += sight.in_frame
    if offsets is None:
        raise ValueError("there must be a picture")
    rgb = (colour / weight.clamp_min(1e-6)[..., None]).clamp(0, 1)
    return TexelMaps(rgb, seen, torch.where(looked > 0, inside / looked.clamp_min(1), 1.0), offsets)


def to_atlas(values: Tensor, texels: Texels) -> Tensor:
    """(D, S, S) map of ``values`` (P, D) at the texels, 0 elsewhere."""
    atlas = values.new_zeros(values.shape[1], texels.resolution**2)
    atlas[:, texels.index] = values.T
    return atlas.unflatten(1, (texels.resolution, texels.resolution))


def from_atlas(atlas: Tensor, texels: Texels) -> Tensor:
    """(P, D) of a map (D, S, S); differentiable."""
    return atlas.flatten(1).index_select(1, texels.index).T


@dataclass(frozen=True)
class _Sight:
    """One scaffold in one view: (P, 3) premultiplied colour, (P,) alpha, cosine (0 where hidden), in the frame."""

    rgb: Tensor
    alpha: Tensor
    cosine: Tensor
    in_frame: Tensor


def _sight(sitter: CapturedPerson, picture: Picture, vertices: np.ndarray, normals: Tensor, scale: float) -> _Sight:
    """What ``picture`` shows of the scaffold with ``vertices`` (M, 3) and ``normals`` (P, 3); ``scale`` is a metre."""
    camera = picture.cameras
    world = _at_texels(sitter, vertices)
    at, depth = _projected(world, camera)
    in_frame = (depth > 0) & (at >= 0).all(1) & (at < at.new_tensor([camera.width, camera.height])).all(1)
    cosine = (torch.nn.functional.normalize(camera.centers[0] - world, dim=1) * normals).sum(1)
    alpha = torch.ones_like(picture.rgb_premultiplied[..., 0]) if picture.alpha is None else picture.alpha
    found = _sampled(torch.cat([picture.rgb_premultiplied, alpha[..., None]], dim=-1), at) * in_frame[:, None]
    # On a slanting surface the pixels around a texel see what is nearer, by their width over the cosine.
    slack = scale * _SLACK + _SLANT * depth / camera.intrinsics[0, 0, 0] / cosine.clamp_min(_GRAZING)
    is_clear = depth <= _nearest(vertices, sitter.body.faces.numpy(), camera, at) + slack
    return _Sight(
        rgb=found[:, :3],
        alpha=found[:, 3],
        cosine=torch.where(is_clear & in_frame & (cosine > _GRAZING), cosine, 0.0),
        in_frame=in_frame.float(),
    )


def _nearest(vertices: np.ndarray, faces: np.ndarray, camera: Cameras, at: Tensor) -> Tensor:
    """(P,) depth of the mesh at the nearest of the four pixels around the places ``at`` (P, 2); far where none is."""
    places, depth = (x.double().numpy() for x in _projected(torch.from_numpy(vertices), camera))
    corners = np.concatenate([places - 0.5, 1.0 / depth[:, None]], axis=1)[faces]
    corners[(depth[faces] <= 0).any(axis=1)] = 0.0  # behind the camera: without area, so that nothing is covered
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
    return torch.from_numpy(least)[row, column].float()


def _projected(world: Tensor, camera: Cameras) -> tuple[Tensor, Tensor]:
    """Column and row (X, 2) in pixels, and depth (X,), of places (X, 3)."""
    pose, intrinsics = camera.cam_from_world[0].to(world), camera.intrinsics[0].to(world)
    seen = world @ pose[:3, :3].T + pose[:3, 3]
    return (seen @ intrinsics.T)[:, :2] / seen[:, 2:].clamp_min(1e-6), seen[:, 2]


def _sampled(picture: Tensor, at: Tensor) -> Tensor:
    """(P, D) of a picture (H, W, D) at columns and rows ``at`` (P, 2), bilinear between centres of pixels."""
    size = at.new_tensor([picture.shape[1], picture.shape[0]])
    grid = (2 * at / size - 1).nan_to_num().clamp(-2, 2)[None, None]
    planes = picture.permute(2, 0, 1)[None]
    found = torch.nn.functional.grid_sample(planes, grid, padding_mode="border", align_corners=False)
    return found[0, :, 0].T


def _at_texels(sitter: CapturedPerson, values: np.ndarray) -> Tensor:
    """(P, 3) between the vertices around each texel of ``values`` (M, 3) at the vertices."""
    around = torch.from_numpy(values).float()[sitter.body.faces[sitter.texels.faces]]
    return (sitter.texels.barycentric[..., None] * around).sum(1)


def _posed(sitter: CapturedPerson, posing: BodyPose, height: float) -> np.ndarray:
    """(M, 3) vertices of a scaffold in the world."""
    body = sitter.body
    vertices = body.vertices + height * sitter.normals
    if body.pose_dirs is not None:
        bends = (posing.rotations[1:] - torch.eye(3)).flatten()
        vertices = vertices + (bends @ body.pose_dirs).unflatten(0, (-1, 3))
    transforms = blend_transforms(body.weights, joint_transforms(body.joints, body.parents, posing.rotations))
    return (posing.scale * apply_transforms(transforms, vertices) + posing.trans).numpy()
