"""The texture of a person: what the Gaussians at rest look like from straight above each texel of
the atlas.

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
from dyngs.human.motion.placement import rest_clip
from dyngs.ops.harmonics import harmonics_basis
from dyngs.ops.quaternions import rotation_matrices

_NEAR = 20  # Gaussians that are looked for at each height above a texel
_HEIGHTS = (-0.015, 0.005, 0.025, 0.05)
"""Heights, m, where they are looked for: below the skin, on it, in clothes and hair."""
_REACH = (-0.04, 0.07)  # heights, m, between which Gaussians belong to a texel
_FACING = 0.3
"""Least cosine between the normals of a texel and of a Gaussian that belongs to it: arms do not
colour the trunk."""
_TOP = 0.1  # fraction of what is seen from which a texel counts as covered
_CHUNK = 8192
SEEN = 0.1  # opacity from which a texel has a colour of its own
_MIRROR = 0.02  # distance, m, within which the mirror image of a texel is looked for
_GAP = 0.015  # distance, m, to what is seen, up to which a texel lies in a small gap
_AROUND = 16  # texels that colour one in a gap, or one that is not seen on either side


@dataclass(frozen=True)
class BakedTexels:
    """What is seen straight above P texels."""

    rgb: Tensor  # (P, 3) in [0, 1], display-referred as the images were
    alpha: Tensor  # (P,) opacity
    # (P,) height above the surface at rest, m, of the Gaussian at which a tenth of what is seen is
    # reached
    top: Tensor


def bake_texels(scene: HumanScene, texels: Texels, normals: Tensor) -> BakedTexels:
    """Return what the Gaussians at rest show along the normal of each texel, blended from the
    outside in.

    ``texels``: P of the template in the person's shape. ``normals``: (N, 3) of the surface below
    each Gaussian at rest.
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
        parts.append(_blended(torch.where(belongs, alpha, 0.0), height, colours[near]))
    return BakedTexels(*(torch.cat(x) for x in zip(*parts, strict=True)))


def frontal_colours(scene: HumanScene, normals: Tensor) -> Tensor:
    """Return the colours (N, 3) of Gaussians seen against ``normals`` (N, 3) at rest; a network's,
    in the rest pose."""
    gaussians = scene.gaussians
    seen_along = -normals
    if scene.colour is not None:
        upright = scene.with_motion(
            rest_clip(scene.clip, scene.skeleton.joints, scene.skeleton.parents)
        )
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
    """Return the Gaussians (P, K) near and above ``points`` (P, 3), ascending; some more than
    once."""
    count = min(_NEAR, places.n)
    found = [
        places.query((points + h * along).numpy(), k=count)[1].reshape(len(points), count)
        for h in _HEIGHTS
    ]
    return torch.from_numpy(np.sort(np.concatenate(found, axis=1), axis=1))


def _blended(alpha: Tensor, height: Tensor, colours: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return colours (P, 3), opacity (P,) and top (P,) of (P, K) Gaussians blended from the highest
    down."""
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
    """Return colours (P, 3) of all texels: small gaps from around them, else those of the mirror side,
    else what is nearest.

    Texels count as the same surface where their normals agree, so that an arm does not colour the
    trunk.
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
    """Return the atlas (S, S, 3) uint8; what no triangle covers has the colour of the nearest
    texel.

    So neither interpolation nor smaller copies of the image show seams.
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
    """Return (P, 6): places and normals, where opposite normals are as far apart as points at 10
    cm."""
    return torch.cat([points, 0.05 * normals], dim=1).double().numpy()
