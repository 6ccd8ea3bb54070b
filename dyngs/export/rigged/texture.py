"""Texture of a person, baked from rest-pose Gaussians along the normal of each texel.

Local letters: N Gaussians, P texels, K Gaussians near a texel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree
from torch import Tensor

from dyngs.gaussians.colour.network import bake_harmonics
from dyngs.human.avatar.posing import frame_pose
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.atlas import Texels
from dyngs.human.body.skinning import blend_transforms, joint_transforms
from dyngs.ops.harmonics import harmonics_basis
from dyngs.ops.quaternions import rotation_matrices

_NEAR = 20  # Gaussians searched at each height above a texel
# Search heights in m: below the skin, on it, in clothes and hair
_HEIGHTS = (-0.015, 0.005, 0.025, 0.05)
_REACH = (-0.04, 0.07)  # Heights in m between which Gaussians belong to a texel
# Smallest cosine between normals of a texel and its Gaussians, so that arms do not colour the trunk
_FACING = 0.3
_TOP = 0.1  # Fraction of the blended opacity that defines the height of the surface
_CHUNK = 8192  # Texels processed at once
SEEN = 0.1  # Opacity above which a texel counts as seen
_MIRROR = 0.02  # Search radius in m around the mirror image of a texel
_GAP = 0.015  # Distance in m to seen texels below which a gap is filled from its surroundings
_AROUND = 16  # Texels averaged to fill a gap


@dataclass(frozen=True)
class BakedTexels:
    """Colour, opacity and height of P texels."""

    rgb: Tensor  # (P, 3) in [0, 1], in the colour space of the images
    alpha: Tensor  # (P,) opacity
    # (P,) height in m above the rest surface at which a tenth of the opacity is reached
    top: Tensor


def bake_texels(scene: HumanScene, texels: Texels, normals: Tensor) -> BakedTexels:
    """Blend the rest-pose Gaussians along the normal of each texel, from outside to inside.

    Args:
        texels: P texels of the template in the shape of the person.
        normals: (N, 3) surface normals at the Gaussians in rest pose.
    """
    colours = frontal_colours(scene, normals)
    gaussians = scene.gaussians
    to_own = rotation_matrices(gaussians.quats).transpose(1, 2) / gaussians.scales[..., None]
    places = KDTree(gaussians.means.numpy())
    parts = []
    for rows in torch.arange(len(texels), device="cpu").split(_CHUNK):
        points = texels.points[rows]
        along = texels.normals[rows]
        near = _neighbours(places, points, along)
        offset = points[:, None] - gaussians.means[near]
        turn = to_own[near]
        start = (turn @ offset[..., None])[..., 0]
        step = (turn @ along[:, None, :, None])[..., 0]
        speed = step.square().sum(-1)
        height = -(start * step).sum(-1) / speed
        distance = (start.square().sum(-1) - height.square() * speed).clamp_min(0)
        alpha = gaussians.opacities[near] * (-0.5 * distance).exp()
        belongs = (height > _REACH[0]) & (height < _REACH[1])
        belongs &= (normals[near] * along[:, None]).sum(-1) > _FACING
        belongs[:, 1:] &= near[:, 1:] != near[:, :-1]
        parts.append(_blend(torch.where(belongs, alpha, 0.0), height, colours[near]))
    return BakedTexels(*(torch.cat(x) for x in zip(*parts, strict=True)))


def frontal_colours(scene: HumanScene, normals: Tensor) -> Tensor:
    """Return the colours (N, 3) of Gaussians viewed against ``normals`` (N, 3) in rest pose."""
    gaussians = scene.gaussians
    seen_along = -normals
    if scene.colour is not None:
        upright = scene.at_rest()
        moment = upright.time_step(None)
        shader = upright.shader(moment)
        if shader is not None:
            gaussians = bake_harmonics(moment.gaussians, shader).gaussians
        posing = frame_pose(upright.played_clip, 0)
        skeleton = scene.learned_skeleton
        joints = joint_transforms(skeleton.joints, skeleton.parents, posing.rotations)
        linear = blend_transforms(scene.weights, joints)[..., :3]
        seen_along = torch.nn.functional.normalize((linear @ seen_along[..., None])[..., 0], dim=1)
    basis = harmonics_basis(seen_along, gaussians.sh_degree)
    return ((basis[..., None] * gaussians.sh).sum(1) + 0.5).clamp(0, 1)


def _neighbours(places: KDTree, points: Tensor, along: Tensor) -> Tensor:
    """Return indices (P, K) of Gaussians near and above ``points`` (P, 3), ascending, with
    duplicates."""
    count = min(_NEAR, places.n)
    found = [
        places.query((points + h * along).numpy(), k=count)[1].reshape(len(points), count)
        for h in _HEIGHTS
    ]
    return torch.from_numpy(np.sort(np.concatenate(found, axis=1), axis=1))


def _blend(alpha: Tensor, height: Tensor, colours: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Blend (P, K) Gaussians from the highest down. Return colours (P, 3), opacity (P,) and top
    (P,)."""
    order = height.argsort(dim=1, descending=True, stable=True)
    alpha = alpha.gather(1, order)
    height = height.gather(1, order)
    clear = (1 - alpha).cumprod(dim=1)
    weight = alpha * torch.cat([torch.ones_like(clear[:, :1]), clear[:, :-1]], dim=1)
    colours = colours.gather(1, order[..., None].expand(-1, -1, 3))
    total = weight.sum(1)
    fraction = weight / total.clamp_min(1e-8)[:, None]
    first = (fraction.cumsum(1) < _TOP).sum(1, keepdim=True).clamp_max(fraction.shape[1] - 1)
    return (fraction[..., None] * colours).sum(1), total, height.gather(1, first)[:, 0]


def fill_unseen(baked: BakedTexels, texels: Texels) -> Tensor:
    """Return colours (P, 3) of all texels, with unseen ones filled.

    Small gaps are filled from their surroundings, others from the mirror side, else from the
    nearest texels. Only texels with similar normals are used.
    """
    seen = baked.alpha >= SEEN
    rgb = baked.rgb.clone()
    missing = torch.nonzero(~seen)[:, 0]
    known = torch.nonzero(seen)[:, 0]
    if not len(missing) or not len(known):
        return rgb
    places = KDTree(_with_normals(texels.points[known], texels.normals[known]))
    points = texels.points[missing]
    normals = texels.normals[missing]
    distance, at = (
        torch.from_numpy(x.reshape(len(missing), -1))
        for x in places.query(_with_normals(points, normals), k=min(_AROUND, len(known)))
    )
    weight = (1 / distance.clamp_min(1e-6).square()).float()
    around = baked.rgb[known[at]]
    rgb[missing] = (weight[..., None] * around).sum(1) / weight.sum(1, keepdim=True)
    flip = points.new_tensor([-1.0, 1.0, 1.0])
    beyond, at = places.query(_with_normals(points * flip, normals * flip))
    mirrored = (distance[:, 0] > _GAP) & torch.from_numpy(beyond < _MIRROR)
    rgb[missing[mirrored]] = baked.rgb[known[torch.from_numpy(at)[mirrored]]]
    return rgb


def texture_image(rgb: Tensor, texels: Texels) -> np.ndarray:
    """Return the texture (S, S, 3) uint8. Uncovered texels have the colour of the nearest covered
    one.

    This avoids seams with interpolation and mipmaps.
    """
    size = texels.resolution
    image = np.zeros((size * size, 3), np.float32)
    empty = np.ones(size * size, bool)
    image[texels.index.numpy()] = rgb.numpy()
    empty[texels.index.numpy()] = False
    rows, columns = np.asarray(
        distance_transform_edt(
            empty.reshape(size, size), return_distances=False, return_indices=True
        )
    )
    nearest = image.reshape(size, size, 3)[rows, columns]
    return np.rint(nearest.clip(0, 1) * 255).astype(np.uint8)


def _with_normals(points: Tensor, normals: Tensor) -> np.ndarray:
    """Return (P, 6): positions, and normals scaled so that opposite ones are 10 cm apart."""
    return torch.cat([points, 0.05 * normals], dim=1).double().numpy()
