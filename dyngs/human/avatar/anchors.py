"""Gaussians on the texels of a body template's atlas, and what ties them to its skeleton.

Local letters: K joints that one Gaussian follows, P texels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dyngs.core.camera import Cameras
from dyngs.core.conventions import num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.core.state import fields_moved_to
from dyngs.gaussians import Gaussians
from dyngs.human.body.atlas import Texels, atlas_texels
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.motion.motion import MotionClip
from dyngs.ops.quaternions import quats_of

# limit on the joints that one Gaussian follows; vertices of the free template follow no more
MAX_JOINTS = 8
_WIDTH, _THICKNESS = 0.5, 0.25
"""Standard deviations of an initial Gaussian in the tangent plane and along the normal, in sides of
its texel."""
# initial opacities: on the lowest scaffold, and on those above it
_LOWEST_OPACITY, _UPPER_OPACITY = 0.9, 0.1


@dataclass(frozen=True)
class Anchors:
    """Constant attributes that tie N Gaussians to the template, row by row."""

    points: Tensor  # (N, 3) at rest on the scaffold, m
    size: Tensor  # (N,) side of the texel, m
    joints: Tensor  # (N, K) int64 joints that the Gaussian follows, heaviest first
    weights: Tensor  # (N, K) skinning weights of these joints, rows sum to 1
    face: Tensor  # (N,) int64 triangle of the template that holds the texel's centre
    barycentric: Tensor  # (N, 3) of the texel's centre in that triangle
    uv: Tensor  # (N, 2) of the texel's centre in the atlas
    height: Tensor  # (N,) of the scaffold above the skin, m

    def __len__(self) -> int:
        return len(self.points)

    def select(self, index: Tensor) -> Anchors:
        """Return the rows at ``index`` (long or bool)."""
        return Anchors(**{name: x[index] for name, x in self.tensors().items()})

    def to(self, *, device: torch.device | str) -> Anchors:
        """Return the anchors on ``device``."""
        return fields_moved_to(self, device)

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors by field name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


def texel_gaussians(
    texels: Texels, heights: Sequence[float], sh_degree: int
) -> tuple[Gaussians, Anchors]:
    """Return grey discs on every texel, at all ``heights`` (m) above the surface at rest; nearly
    opaque at the lowest.

    A disc lies in the tangent plane, as wide as its texel. Rows are ordered by height, then by
    texel. Raises DyngsError: no height, or one that is not finite.
    """
    levels = texels.points.new_tensor(heights)
    if levels.numel() == 0 or not bool(levels.isfinite().all()):
        raise DyngsError(
            f"the heights of scaffolds must be one or more finite numbers of metres, got {list(heights)}"
        )
    rows = torch.arange(len(texels), device=levels.device).repeat(len(levels))
    height = levels.repeat_interleave(len(texels))
    size = texels.size[rows]
    joints, weights = heaviest_joints(texels.weights)
    row = texels.index // texels.resolution
    column = texels.index % texels.resolution
    uv = (
        torch.stack([column + 0.5, texels.resolution - 0.5 - row], dim=1).to(size)
        / texels.resolution
    )
    anchors = Anchors(
        points=texels.points[rows] + height[:, None] * texels.normals[rows],
        size=size,
        joints=joints[rows],
        weights=weights[rows],
        face=texels.faces[rows],
        barycentric=texels.barycentric[rows],
        uv=uv[rows],
        height=height,
    )
    ratios = size.new_tensor([_WIDTH, _WIDTH, _THICKNESS]).log()
    opacity = torch.where(height == min(heights), _LOWEST_OPACITY, _UPPER_OPACITY)
    gaussians = Gaussians(
        means=anchors.points.clone(),
        quats=quats_of(texels.frames)[rows],
        log_scales=size.log()[:, None] + ratios,
        logit_opacities=(opacity / (1 - opacity)).log().to(size),
        sh=size.new_zeros(len(rows), num_sh_terms(sh_degree), 3),
    )
    return gaussians, anchors


def heaviest_joints(weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the joints (P, K) int64 of the largest of ``weights`` (P, J), and these, normalised;
    ties by index."""
    count = min(MAX_JOINTS, weights.shape[1])
    ordered = weights.sort(dim=1, descending=True, stable=True)
    kept = ordered.values[:, :count]
    return ordered.indices[:, :count].contiguous(), kept / kept.sum(1, keepdim=True)


def skinning_weights(
    anchors: Anchors, num_joints: int, corrections: Tensor | None = None
) -> Tensor:
    """Return skinning weights (N, J); with ``corrections`` c (N, K), w e^c, normalised, for the
    followed joints.

    Corrections have no effect where a Gaussian follows a single joint: they act where parts of the
    body meet.
    """
    if corrections is None:
        return anchors.weights.new_zeros(len(anchors), num_joints).scatter_add_(
            1, anchors.joints, anchors.weights
        )
    return cast(Any, _CorrectedWeights).apply(
        corrections, anchors.weights, anchors.joints, num_joints
    )


class _CorrectedWeights(torch.autograd.Function):
    """See ``skinning_weights``; differentiable once, in the corrections."""

    @staticmethod
    def forward(
        ctx: Any, corrections: Tensor, weights: Tensor, joints: Tensor, num_joints: int
    ) -> Tensor:
        parts = corrections.exp().mul_(weights)
        parts /= parts.sum(1, keepdim=True)
        ctx.save_for_backward(parts, joints)
        return parts.new_zeros(len(parts), num_joints).scatter_add_(1, joints, parts)

    @staticmethod
    @once_differentiable  # whose type hides the name of ctx
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        parts, joints = ctx.saved_tensors
        by_parts = grads[0].gather(1, joints).mul_(parts)
        return by_parts - parts * by_parts.sum(1, keepdim=True), None, None, None


FINER = 2  # texels of the finer atlas along a side of one
PIXELS = 2.0  # pixels along the side of a texel from which it is replaced by smaller ones
_LIMBS = ("wrist", "ankle", "foot", "index", "middle", "pinky", "ring", "thumb")


def pixel_size(cameras: Sequence[Cameras], clip: MotionClip, pelvis: Tensor) -> float:
    """Return the side of a pixel on the person, m of the template: the median over the cameras;
    infinite without any.

    The mean position in ``clip`` counts; ``pelvis`` (3,) is at rest, m.
    """
    scale = float(clip.scale.mean())
    place = clip.trans.mean(0) + scale * pelvis
    away = [
        float((camera.centers[0] - place).norm() / camera.intrinsics[0, 0, 0]) for camera in cameras
    ]
    return sorted(away)[len(away) // 2] / scale if away else torch.inf


def surface_texels(
    body: BodyTemplate, resolution: int, vertices: Tensor, pixel: float
) -> list[Texels]:
    """Return the texels of the atlas, and apart from them smaller ones of hands and feet where
    images show more.

    ``vertices`` (M, 3) are the rest shape, m; ``pixel`` is the side of a pixel on the person, m.
    """
    texels = atlas_texels(body, resolution, vertices)
    named = [any(part in name for part in _LIMBS) for name in JOINT_NAMES[: len(body.parents)]]
    limbs = torch.tensor(named, device=texels.points.device)
    on_limbs = limbs[texels.weights.argmax(1)]
    if not bool(on_limbs.any()) or float(texels.size[on_limbs].median()) < PIXELS * pixel:
        return [texels]
    fine = atlas_texels(body, FINER * resolution, vertices)
    return [texels.select(~on_limbs), fine.select(limbs[fine.weights.argmax(1)])]


def surface_gaussians(parts: Sequence[Texels], sh_degree: int) -> tuple[Gaussians, Anchors, Tensor]:
    """Return the ``texel_gaussians`` on the skin of all parts, part by part, their anchors, and
    normals (N, 3)."""
    made = [texel_gaussians(texels, (0.0,), sh_degree) for texels in parts]
    normals = torch.cat([texels.normals for texels in parts])
    anchors = {
        name: torch.cat([a.tensors()[name] for _, a in made]) for name in made[0][1].tensors()
    }
    return Gaussians.joined([g for g, _ in made]), Anchors(**anchors), normals
