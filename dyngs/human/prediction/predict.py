"""Gaussians at rest predicted from texel maps, by the network or without one.

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
from dyngs.human.prediction.texel_maps import HULL_LIMIT, TexelMaps, from_atlas, to_atlas
from dyngs.ops.quaternions import unit_quats

_MAX_LOG_SCALE = 1.5
"""Limit on the difference of log scales from those of the initial Gaussian."""

_IMAGE_LOGIT = 4.0
"""Logit of the weight of the images' colours in an untrained network, against predicted colours."""

_GUESS_LOGITS = (0.0, 2.0, 0.0)
"""Logits of the fractions of the three ``guessed_colours`` in an untrained network."""

_MAX_HEIGHT = 0.01
"""Limit on the offset along the normal with a single scaffold, m; with several: half their distance."""


@dataclass(frozen=True)
class PredictedAvatar:
    """N Gaussians at rest, and the captured person with their anchors."""

    gaussians: Gaussians
    subject: Subject


def num_input_channels(scaffolds: int) -> int:
    """Return the number of input channels D of a network for so many scaffolds."""
    return 6 * scaffolds + 18


def network_inputs(person: CapturedPerson, maps: TexelMaps, mean: Tensor) -> Tensor:
    """Return the input (D, S, S): per scaffold colour, cosine, silhouettes; then offsets, points, guesses of colours.

    Args:
        person: the captured person.
        maps: of the images.
        mean: (3, S, S) mean colours of the training people.
    """
    measured = torch.stack([maps.seen, maps.inside, maps.hull / HULL_LIMIT], dim=-1)
    scaffolds = torch.cat([maps.rgb, measured], dim=-1)
    guesses = guessed_colours(person, maps, mean)
    ones = torch.ones(len(person.texels), 1, device=scaffolds.device)
    rest = [maps.offsets, person.texels.points, *guesses, maps.seen[0][person.mirror, None], ones, ones / maps.count]
    return to_atlas(torch.cat([*scaffolds, *rest], dim=1), person.texels)


def guessed_colours(person: CapturedPerson, maps: TexelMaps, mean: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return three guesses (P, 3) of the colours of texels that no image shows: the mean colours of the training
    people, those of seen texels nearby, and those of the other side where it is seen, else as nearby."""
    is_seen = maps.seen[0][person.mirror, None] > 0
    return from_atlas(mean, person.texels), maps.nearby, torch.where(is_seen, maps.rgb[0][person.mirror], maps.nearby)


def predict_gaussians(
    person: CapturedPerson, maps: TexelMaps, mean: Tensor, network: AtlasNetwork | None, min_silhouette_fraction: float
) -> PredictedAvatar:
    """Return the avatar that ``network`` predicts, differentiable in its weights; None: discs in observed colours.

    All texels of the lowest scaffold get a Gaussian; those above it where a view sees them and they lie inside at
    least the share ``min_silhouette_fraction`` of the silhouettes. Rotations are relative to the tangent frame, scales
    to the initial Gaussian, means move along the normal. Colours are a weighted mean of those of the images and those
    of the network, which mixes and corrects the ``guessed_colours``; without a network those of the images.

    Args:
        person: the captured person.
        maps: of the images.
        mean: (3, S, S) as in ``network_inputs``.
        network: or None.
        min_silhouette_fraction: in [0, 1].
    """
    kept = (maps.inside >= min_silhouette_fraction) & (maps.seen > 0)
    kept[0] = True
    rows = kept.flatten().nonzero()[:, 0]
    first, subject = person.gaussians.select(rows), replace(person.subject, anchors=person.subject.anchors.select(rows))
    seen, observed = maps.seen.flatten()[rows], maps.rgb.flatten(0, 1)[rows]
    guesses = torch.stack(guessed_colours(person, maps, mean))[:, rows % len(person.texels)]
    if network is None:
        rgb = torch.where(seen[:, None] > 0, observed, maps.nearby[rows % len(person.texels)])
        return PredictedAvatar(first.replace(sh=((rgb - 0.5) / SH_C0)[:, None]), subject)
    raw = network(network_inputs(person, maps, mean))
    raw = torch.cat([from_atlas(level, person.texels) for level in raw]).index_select(0, rows)
    part = dict(zip(HEADS, raw.split(tuple(HEADS.values()), dim=1), strict=True))
    weight = (part["image_weight"] + _IMAGE_LOGIT).sigmoid() * (seen[:, None] > 0)
    fractions = (part["guess"] + part["guess"].new_tensor(_GUESS_LOGITS)).softmax(dim=1)
    guess = (fractions.T[..., None] * guesses).sum(0) + part["colour"]
    rgb = weight * observed + (1 - weight) * guess
    normals = person.texels.normals[rows % len(person.texels)]
    gaussians = Gaussians(
        means=first.means + _max_height(person.heights) * part["height"].tanh() * normals,
        quats=_rotated(first.quats, part["rotation"]),
        log_scales=first.log_scales + _MAX_LOG_SCALE * (part["scale"] / _MAX_LOG_SCALE).tanh(),
        logit_opacities=first.logit_opacities + part["opacity"][:, 0],
        sh=((rgb - 0.5) / SH_C0)[:, None],
    )
    return PredictedAvatar(gaussians, subject)


def _max_height(heights: tuple[float, ...]) -> float:
    """Return the limit on the offset along the normal, m."""
    return min((0.5 * (b - a) for a, b in pairwise(heights)), default=_MAX_HEIGHT)


def _rotated(quats: Tensor, changes: Tensor) -> Tensor:
    """Return Hamilton products q r (N, 4), wxyz, of ``quats`` q with normalised quaternions r of 1 + ``changes``.

    Not ``quat_product``, whose sums round otherwise: predictions would differ in last bits.
    """
    one = changes.new_tensor([1.0, 0.0, 0.0, 0.0])
    w, *xyz = unit_quats(one + changes).unbind(1)
    a, vector, other = quats[:, :1], quats[:, 1:], torch.stack(xyz, dim=1)
    real = a * w[:, None] - (vector * other).sum(1, keepdim=True)
    return torch.cat([real, a * other + w[:, None] * vector + torch.linalg.cross(vector, other, dim=1)], dim=1)
