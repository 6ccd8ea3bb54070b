"""From maps of what pictures show to Gaussians at rest, by a network or without one.

Local letters: P texels, K scaffolds, N Gaussians, S texels per side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from dyngs.conventions import SH_C0
from dyngs.gaussians import Gaussians
from dyngs.human.avatar.subject import Subject
from dyngs.human.prediction.network import HEADS, AtlasNetwork
from dyngs.human.prediction.person import CapturedPerson
from dyngs.human.prediction.texel_maps import TexelMaps, from_atlas, to_atlas
from dyngs.ops.quaternions import unit_quats

_STRETCH = 1.5
"""How far logarithms of lengths may differ from those of a first Gaussian."""

_TRUST = 4.0
"""Logit at which an untrained network takes a colour from the pictures, rather than painting it."""

_RISE = 0.01
"""How far a Gaussian may rise above or sink below the only scaffold, m; of several, half of what lies between them."""


@dataclass(frozen=True)
class PredictedAvatar:
    """N Gaussians at rest, and the person they belong to, whose anchors are theirs."""

    gaussians: Gaussians
    subject: Subject


def num_input_channels(scaffolds: int) -> int:
    """Channels of the maps that a network for so many scaffolds takes."""
    return 5 * scaffolds + 10


def network_inputs(sitter: CapturedPerson, maps: TexelMaps, mean: Tensor) -> Tensor:
    """(D, S, S) what the network sees: per scaffold colour, cosine and silhouettes; then offsets, places, mean colours.

    Args:
        sitter: the person.
        maps: of the pictures.
        mean: (3, S, S) colours of the people that were trained on.
    """
    scaffolds = torch.cat([maps.rgb, maps.seen[..., None], maps.inside[..., None]], dim=-1)
    ones = torch.ones(len(sitter.texels), 1)
    values = torch.cat([*scaffolds, maps.offsets, sitter.texels.points, from_atlas(mean, sitter.texels), ones], dim=1)
    return to_atlas(values, sitter.texels)


def predict_gaussians(
    sitter: CapturedPerson, maps: TexelMaps, mean: Tensor, network: AtlasNetwork | None, carve: float
) -> PredictedAvatar:
    """The avatar that ``network`` predicts; differentiable in its weights. Without one: discs in seen or mean colours.

    All texels of the lowest scaffold have a Gaussian; those above it where a view sees them and they lie inside a share
    ``carve`` of the silhouettes. Rotations are relative to the tangent frame, lengths to a first Gaussian's, places
    move along the normal; colours are those of the pictures where the network trusts them, else painted by it.

    Args:
        sitter: the person.
        maps: of the pictures.
        mean: (3, S, S) as in ``network_inputs``.
        network: None for none.
        carve: in [0, 1].
    """
    kept = (maps.inside >= carve) & (maps.seen > 0)
    kept[0] = True
    rows = kept.flatten().nonzero()[:, 0]
    first, subject = sitter.gaussians.select(rows), replace(sitter.subject, anchors=sitter.subject.anchors.select(rows))
    seen, shown = maps.seen.flatten()[rows], maps.rgb.flatten(0, 1)[rows]
    average = from_atlas(mean, sitter.texels)[rows % len(sitter.texels)]
    if network is None:
        rgb = torch.where(seen[:, None] > 0, shown, average)
        return PredictedAvatar(first.replace(sh=((rgb - 0.5) / SH_C0)[:, None]), subject)
    raw = network(network_inputs(sitter, maps, mean))
    raw = torch.cat([from_atlas(level, sitter.texels) for level in raw]).index_select(0, rows)
    part = dict(zip(HEADS, raw.split(tuple(HEADS.values()), dim=1), strict=True))
    trust = (part["trust"] + _TRUST).sigmoid() * (seen[:, None] > 0)
    rgb = trust * shown + (1 - trust) * (average + part["paint"])
    normals = sitter.texels.normals[rows % len(sitter.texels)]
    gaussians = Gaussians(
        means=first.means + _reach(sitter.heights) * part["rise"].tanh() * normals,
        quats=_turned(first.quats, part["turn"]),
        log_scales=first.log_scales + _STRETCH * (part["stretch"] / _STRETCH).tanh(),
        logit_opacities=first.logit_opacities + part["opacity"][:, 0],
        sh=((rgb - 0.5) / SH_C0)[:, None],
    )
    return PredictedAvatar(gaussians, subject)


def _reach(heights: tuple[float, ...]) -> float:
    """m."""
    return min((0.5 * (b - a) for a, b in pairwise(heights)), default=_RISE)


def _turned(quats: Tensor, turns: Tensor) -> Tensor:
    """(N, 4) the rotations ``quats`` after the unit quaternions along 1 + ``turns`` (N, 4), each normalised by itself.

    Hamilton product q r, wxyz; not ``quat_product``, whose sums round otherwise: predictions would differ in last bits.
    """
    one = turns.new_tensor([1.0, 0.0, 0.0, 0.0])
    w, *xyz = unit_quats(one + turns).unbind(1)
    a, vector, other = quats[:, :1], quats[:, 1:], torch.stack(xyz, dim=1)
    real = a * w[:, None] - (vector * other).sum(1, keepdim=True)
    return torch.cat([real, a * other + w[:, None] * vector + torch.linalg.cross(vector, other, dim=1)], dim=1)
