"""Gaussians on the texels of a body template's atlas, and what ties them to its skeleton.

Local letters: N Gaussians, J joints, K joints that one Gaussian follows, P texels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from dyngs.conventions import num_sh_terms
from dyngs.gaussians import Gaussians
from dyngs.human.pose.nearest_rotation import quats_of
from dyngs.human.template.atlas import Texels, scaffold_points

MAX_JOINTS = 8
"""Joints that one Gaussian follows at most; the template's vertices follow no more."""


_WIDTH, _THICKNESS = 0.5, 0.25
"""Standard deviations of a first Gaussian, in texels of the surface: within it, and along its normal."""


_SKIN, _SHELL = 0.9, 0.1
"""Opacities of the first Gaussians: on the lowest scaffold, and on those above it."""


@dataclass(frozen=True)
class Anchors:
    """What ties each of N Gaussians to the template: constant, row by row.

    Attributes:
        points: (N, 3) place at rest on its scaffold, m.
        size: (N,) side of its texel, m.
        joints: (N, K) int64 that it follows, heaviest first.
        weights: (N, K) shares, rows sum to 1.
        face: (N,) int64 triangle of the template in which its texel lies.
        barycentric: (N, 3) of the texel's centre in that triangle.
        uv: (N, 2) of the texel's centre in the atlas.
        height: (N,) of its scaffold above the skin, m.
    """

    points: Tensor
    size: Tensor
    joints: Tensor
    weights: Tensor
    face: Tensor
    barycentric: Tensor
    uv: Tensor
    height: Tensor

    def __len__(self) -> int:
        return len(self.points)

    def select(self, index: Tensor) -> Anchors:
        """The rows at ``index`` (long or bool)."""
        return Anchors(**{name: x[index] for name, x in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """Field name to tensor."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


def texel_gaussians(texels: Texels, heights: Sequence[float], sh_degree: int) -> tuple[Gaussians, Anchors]:
    """Grey discs on every texel, ``heights`` (m) above the surface, at rest; the lowest height is nearly opaque.

    A disc lies in the tangent plane, as wide as its texel; those of one height follow those of the one before.
    """
    places = scaffold_points(texels, heights)
    of = places.texel
    size = texels.size[of]
    joints, weights = heaviest_joints(texels.weights)
    rows, columns = (texels.index // texels.resolution, texels.index % texels.resolution)
    uv = torch.stack([columns + 0.5, texels.resolution - 0.5 - rows], dim=1).to(size) / texels.resolution
    anchors = Anchors(
        points=places.points(texels),
        size=size,
        joints=joints[of],
        weights=weights[of],
        face=texels.faces[of],
        barycentric=texels.barycentric[of],
        uv=uv[of],
        height=places.height,
    )
    ratios = size.new_tensor([_WIDTH, _WIDTH, _THICKNESS]).log()
    opacity = torch.where(places.height == min(heights), _SKIN, _SHELL)
    gaussians = Gaussians(
        means=anchors.points.clone(),
        quats=quats_of(texels.frames)[of],
        log_scales=size.log()[:, None] + ratios,
        logit_opacities=(opacity / (1 - opacity)).log().to(size),
        sh=size.new_zeros(len(places), num_sh_terms(sh_degree), 3),
    )
    return gaussians, anchors


def heaviest_joints(weights: Tensor) -> tuple[Tensor, Tensor]:
    """Joints (P, K) int64 and shares (P, K), normalised, of the heaviest of ``weights`` (P, J); ties by index."""
    count = min(MAX_JOINTS, weights.shape[1])
    ordered = weights.sort(dim=1, descending=True, stable=True)
    kept = ordered.values[:, :count]
    return ordered.indices[:, :count].contiguous(), kept / kept.sum(1, keepdim=True)


def skinning_weights(anchors: Anchors, num_joints: int, corrections: Tensor | None = None) -> Tensor:
    """(N, J) shares; with ``corrections`` (N, K) those of the followed joints are w e^c, normalised.

    Where a Gaussian follows one joint alone no correction does anything: they act where parts of the body meet.
    """
    shares = anchors.weights
    if corrections is not None:
        shares = shares * corrections.exp()
        shares = shares / shares.sum(1, keepdim=True)
    dense = shares.new_zeros(len(anchors), num_joints)
    return dense.scatter_add(1, anchors.joints, shares)
