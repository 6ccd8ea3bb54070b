"""A multilayer perceptron on encoded position and time (Deformable-3DGS: Yang et al. 2024)."""

from __future__ import annotations

import torch
from torch import Tensor

from dyngs.deform.decoder import Decoder, split_heads
from dyngs.deform.field import DeformationField, FieldSetup, Offsets, chosen
from dyngs.deform.keys import MlpField
from dyngs.gaussians.parameters import Parameters

SPACE_FREQUENCIES, TIME_FREQUENCIES = 10, 6  # Octaves of the positional encodings
LR_DECAY = 0.002  # Ratio of the last to the first learning rate
# The input is fed once more into this layer (counted from 0), where there are that many hidden ones
SKIP_LAYER = 5


class Mlp(DeformationField):
    """Offsets by a deep network; starts as the identity, because its last layer starts at zero.

    Differs from Deformable-3DGS in two small ways: time is encoded like position instead of by a
    network of its own, and scales change in the logarithm, so that they stay positive.
    """

    def __init__(self, options: MlpField, setup: FieldSetup, generator: torch.Generator) -> None:
        self.options, self.setup = options, setup
        inputs = 3 * (1 + 2 * SPACE_FREQUENCIES) + 1 + 2 * TIME_FREQUENCIES
        skip = SKIP_LAYER if options.depth > SKIP_LAYER else None
        self.decoder = Decoder(inputs, [options.width] * options.depth, options, skip=skip)
        weights = self.decoder.start_values(generator)
        self.parameters = Parameters(weights, dict.fromkeys(weights, options.lr), LR_DECAY)

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        space = encoded(self.setup.normalized(chosen(means.detach(), rows)), SPACE_FREQUENCIES)
        moment = encoded(space.new_full((1, 1), time), TIME_FREQUENCIES)
        features = torch.cat([space, moment.expand(len(space), -1)], dim=1)
        return split_heads(self.decoder(features, self.parameters), self.options)


def encoded(x: Tensor, num_frequencies: int) -> Tensor:
    """Return (M, D * (1 + 2 L)) ``x`` (M, D) and its sines and cosines at L octaves (NeRF:
    Mildenhall et al. 2020)."""
    octaves = 2.0 ** torch.arange(num_frequencies, dtype=x.dtype, device=x.device)
    angles = (x[:, None, :] * octaves[:, None]).flatten(1)
    return torch.cat([x, angles.sin(), angles.cos()], dim=1)
