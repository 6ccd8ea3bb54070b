"""A multilayer perceptron on encoded position and time (Deformable-3DGS: Yang et al. 2024; SC-GS: Huang et al. 2024)."""

from __future__ import annotations

import torch
from torch import Tensor

from dyngs.config import MlpField
from dyngs.deform.decoder import Decoder, split_heads
from dyngs.deform.field import FieldSetup, Offsets
from dyngs.deform.learned import LearnedTensors
from dyngs.deform.nodes import Nodes, follow, place_nodes

SKIP_LAYER = 5
"""The input is fed once more into this layer (counted from 0), where there are that many hidden ones."""


class Mlp:
    """Offsets by a deep network; starts as the identity, because its last layer starts at zero.

    With ``nodes`` the network is evaluated only at that many points among the moving Gaussians, which follow them by
    linear blend skinning; the points are placed anew whenever the set of Gaussians changes.

    Differs from Deformable-3DGS in two small ways: time is encoded like position instead of by a network of its own, and
    scales change in the logarithm, so that they stay positive.
    """

    def __init__(self, options: MlpField, setup: FieldSetup, generator: torch.Generator) -> None:
        self.options, self.setup = options, setup
        self.buffers: dict[str, Tensor] = {}
        inputs = 3 * (1 + 2 * options.space_frequencies) + 1 + 2 * options.time_frequencies
        skip = SKIP_LAYER if options.depth > SKIP_LAYER else None
        self.decoder = Decoder(inputs, [options.width] * options.depth, options, skip=skip)
        weights = self.decoder.start_values(generator)
        self.learned = LearnedTensors(weights, dict.fromkeys(weights, options.lr), options.lr_decay)

    def offsets(self, means: Tensor, time: float) -> Offsets:
        """See ``DeformationField.offsets``; no gradient flows to ``means``, as in the paper."""
        means = means.detach()
        if not self.options.nodes or not len(means):
            return self._offsets_at(means, time)
        nodes = self._nodes(means)
        return follow(nodes, means, self._offsets_at(nodes.positions, time))

    def penalties(self) -> dict[str, Tensor]:
        return {}

    def extend(self, seen: tuple[float, float], soon: tuple[float, float]) -> None:
        """Nothing: the field continues by itself."""

    def select(self, index: Tensor, is_new: Tensor) -> None:
        """Forget the nodes, which are placed anew when next needed."""
        self.buffers = {}

    def _offsets_at(self, points: Tensor, time: float) -> Offsets:
        space = encoded(self.setup.normalized(points), self.options.space_frequencies)
        moment = encoded(space.new_full((1, 1), time), self.options.time_frequencies)
        features = torch.cat([space, moment.expand(len(space), -1)], dim=1)
        return split_heads(self.decoder(features, self.learned), self.options)

    def _nodes(self, means: Tensor) -> Nodes:
        if not self.buffers:
            nodes = place_nodes(means, self.options.nodes)
            self.buffers = {"positions": nodes.positions, "radii": nodes.radii, "followed": nodes.followed}
        return Nodes(self.buffers["positions"], self.buffers["radii"], self.buffers["followed"])


def encoded(x: Tensor, num_frequencies: int) -> Tensor:
    """(M, D * (1 + 2 L)) ``x`` (M, D) and its sines and cosines at L octaves (NeRF: Mildenhall et al. 2020)."""
    octaves = 2.0 ** torch.arange(num_frequencies, dtype=x.dtype)
    angles = (x[:, None, :] * octaves[:, None]).flatten(1)
    return torch.cat([x, angles.sin(), angles.cos()], dim=1)
