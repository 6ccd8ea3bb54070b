"""The network over the atlas: a UNet on maps of observations in a few images (GHG, Kwon et al.
2024).

Local letters: D input channels, K scaffolds, S texels per side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor, nn

from dyngs.core.conventions import SH_C0
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.human.avatar.observations import Subject
from dyngs.human.predict.ghg.person import CapturedPerson
from dyngs.human.predict.ghg.texel_maps import HULL_LIMIT, TexelMaps, from_atlas, to_atlas
from dyngs.models.convolution import GROUPS, ResidualBlock, begin_weights, upsampled
from dyngs.ops.quaternions import unit_quats

HEADS = {
    "rotation": 4,
    "scale": 3,
    "opacity": 1,
    "height": 1,
    "colour": 3,
    "image_weight": 1,
    "guess": 3,
}
"""Outputs per texel of a scaffold and their number of channels; see
``dyngs.human.predict.ghg.network``."""


class AtlasNetwork(nn.Module):
    """UNet from maps (D, S, S) to raw predictions (K, 16, S, S) in the order of ``HEADS``, which
    are 0 before training.

    Each width halves the resolution; the way up concatenates the features of the way down, and at
    full resolution the input itself.
    """

    def __init__(
        self, channels: int, scaffolds: int, widths: Sequence[int], generator: torch.Generator
    ) -> None:
        """D ``channels`` come in, K ``scaffolds`` go out; ``widths`` are channels at 1/2, 1/4, ...
        of the resolution.

        The network is made on the CPU, with weights of ``generator``. Raises DyngsError: a width is
        no multiple of 8.
        """
        super().__init__()
        if any(width % GROUPS for width in widths):
            raise DyngsError(f"model.widths must be multiples of {GROUPS}, not {list(widths)}")
        self.scaffolds, self.halvings = scaffolds, len(widths)
        with torch.device("cpu"):
            self._make_layers(channels, scaffolds, widths)
        begin_weights(self, generator)
        nn.init.zeros_(self.heads.weight)

    def _make_layers(self, channels: int, scaffolds: int, widths: Sequence[int]) -> None:
        self.down = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(before, width, 5 if i == 0 else 3, 2, padding=2 if i == 0 else 1),
                ResidualBlock(width),
            )
            for i, (before, width) in enumerate(zip((channels, *widths), widths, strict=False))
        )
        self.up = nn.ModuleList(
            nn.Sequential(nn.Conv2d(below + width, width, 3, padding=1), ResidualBlock(width))
            for below, width in zip(widths[:0:-1], widths[-2::-1], strict=True)
        )
        self.last = nn.Sequential(
            nn.Conv2d(widths[0] + channels, widths[0], 3, padding=1), nn.SiLU()
        )
        self.heads = nn.Conv2d(widths[0], scaffolds * sum(HEADS.values()), 1)

    def forward(self, maps: Tensor) -> Tensor:
        """Return the raw predictions (K, 16, S, S); S must be a multiple of 2 to the number of
        widths."""
        levels = [maps[None]]
        for layer in self.down:
            levels.append(layer(levels[-1]))
        features = levels.pop()
        for layer in self.up:
            features = layer(torch.cat([upsampled(features), levels.pop()], dim=1))
        features = self.last(torch.cat([upsampled(features), maps[None]], dim=1))
        return self.heads(features)[0].unflatten(0, (self.scaffolds, -1))


_MAX_LOG_SCALE = 1.5  # limit on the difference of log scales from those of the initial Gaussian
# logit of the weight of the images' colours in an untrained network, against predicted colours
_IMAGE_LOGIT = 4.0
# logits of the fractions of the three guessed_colours in an untrained network
_GUESS_LOGITS = (0.0, 2.0, 0.0)
# limit on the offset along the normal with a single scaffold, m; with several: half their distance
_MAX_HEIGHT = 0.01


@dataclass(frozen=True)
class PredictedAvatar:
    """N Gaussians at rest, and the captured person with their anchors."""

    gaussians: Gaussians
    subject: Subject


def num_input_channels(scaffolds: int) -> int:
    """Return the number of input channels D of a network for so many scaffolds."""
    return 6 * scaffolds + 18


def network_inputs(person: CapturedPerson, maps: TexelMaps, mean: Tensor) -> Tensor:
    """Return the input (D, S, S): per scaffold colour, cosine, silhouettes; then offsets, points,
    guesses of colours.

    ``mean`` (3, S, S) are mean colours of the training people.
    """
    measured = torch.stack([maps.seen, maps.inside, maps.hull / HULL_LIMIT], dim=-1)
    scaffolds = torch.cat([maps.rgb, measured], dim=-1)
    guesses = guessed_colours(person, maps, mean)
    ones = torch.ones(len(person.texels), 1, device=scaffolds.device)
    rest = [
        maps.offsets,
        person.texels.points,
        *guesses,
        maps.seen[0][person.mirror, None],
        ones,
        ones / maps.count,
    ]
    return to_atlas(torch.cat([*scaffolds, *rest], dim=1), person.texels)


def guessed_colours(
    person: CapturedPerson, maps: TexelMaps, mean: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return three guesses (P, 3) of the colours of texels that no image shows: the mean colours of
    the training people, those of seen texels nearby, and those of the other side where it is seen,
    else as nearby."""
    is_seen = maps.seen[0][person.mirror, None] > 0
    return (
        from_atlas(mean, person.texels),
        maps.nearby,
        torch.where(is_seen, maps.rgb[0][person.mirror], maps.nearby),
    )


def predict_gaussians(
    person: CapturedPerson,
    maps: TexelMaps,
    mean: Tensor,
    network: AtlasNetwork | None,
    min_silhouette_fraction: float,
) -> PredictedAvatar:
    """Return the avatar that ``network`` predicts, differentiable in its weights; None: discs in
    observed colours.

    All texels of the lowest scaffold get a Gaussian; those above it where a view sees them and they
    lie inside at least the fraction ``min_silhouette_fraction`` of the silhouettes. Rotations are
    relative to the tangent frame, scales to the initial Gaussian, means move along the normal.
    Colours are a weighted mean of those of the images and of the network, which mixes and corrects
    the ``guessed_colours``; without a network those of the images. ``mean`` is as in
    ``network_inputs``.
    """
    kept = (maps.inside >= min_silhouette_fraction) & (maps.seen > 0)
    kept[0] = True
    rows = kept.flatten().nonzero()[:, 0]
    first = person.gaussians.select(rows)
    subject = replace(person.subject, anchors=person.subject.anchors.select(rows))
    seen = maps.seen.flatten()[rows]
    observed = maps.rgb.flatten(0, 1)[rows]
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
    """Return Hamilton products q r (N, 4), wxyz, of ``quats`` q with normalised quaternions r of 1
    + ``changes``.

    Not ``quat_product``, whose sums round otherwise: predictions would differ in last bits.
    """
    one = changes.new_tensor([1.0, 0.0, 0.0, 0.0])
    w, *xyz = unit_quats(one + changes).unbind(1)
    a = quats[:, :1]
    vector = quats[:, 1:]
    other = torch.stack(xyz, dim=1)
    real = a * w[:, None] - (vector * other).sum(1, keepdim=True)
    return torch.cat(
        [real, a * other + w[:, None] * vector + torch.linalg.cross(vector, other, dim=1)], dim=1
    )
