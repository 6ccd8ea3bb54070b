"""Network fields: HexPlane (4DGS, Wu et al. 2024), an MLP (Deformable-3DGS, Yang et al. 2024)."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor

from dyngs.core.initialisation import glorot_layers
from dyngs.deform.field import (
    MAX_KEY_TIMES,
    Decoder,
    DeformationField,
    FieldSetup,
    Offsets,
    head_sizes,
    select_rows,
    split_heads,
)
from dyngs.deform.keys import HexplaneField, MlpField
from dyngs.gaussians.optimizer import Parameters
from dyngs.ops.perceptron import perceptron
from dyngs.ops.planes import PlaneLevel, hexplane_features, plane_penalty

SPACE_RANGE = (0.1, 0.5)
"""Space planes start uniformly in this range, time planes at 1, so that features do not depend on
time."""


class Hexplane(DeformationField):
    """Features from six planes per level, decoded into offsets (4DGS).

    Time spans the whole range of the planes. The decoder's last layer starts at zero, so that the
    field starts as the identity.
    """

    def __init__(
        self, options: HexplaneField, setup: FieldSetup, generator: torch.Generator
    ) -> None:
        self.options, self.setup = options, setup
        tensors: dict[str, Tensor] = {}
        rows = min(max(2, math.ceil(setup.num_times / options.times_per_row)), MAX_KEY_TIMES)
        for level, multiplier in enumerate(options.levels):
            side = options.resolution * multiplier
            space = torch.empty(3, side, side, options.channels, device="cpu")
            tensors[f"space{level}"] = space.uniform_(*SPACE_RANGE, generator=generator)
            tensors[f"time{level}"] = torch.ones(3, rows, side, options.channels, device="cpu")
        hidden = [options.width] * options.depth + [options.width * len(head_sizes(options))]
        num_features = options.channels * len(options.levels)
        self.decoder = Decoder(num_features, hidden, options, separate_heads=options.separate_heads)
        rates = dict.fromkeys(tensors, options.lr_planes * setup.extent)
        weights = self.decoder.start_values(generator)
        rates |= dict.fromkeys(weights, options.lr_decoder * setup.extent)
        self.parameters = Parameters(tensors | weights, rates, options.lr_decay)

    @property
    def levels(self) -> list[PlaneLevel]:
        indices = range(len(self.options.levels))
        return [
            PlaneLevel(self.parameters[f"space{i}"], self.parameters[f"time{i}"]) for i in indices
        ]

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        if not self.options.position_gradient:
            means = means.detach()
        coords = self.setup.normalize(select_rows(means, rows))
        features = hexplane_features(coords, time, self.levels)
        return split_heads(self.decoder(features, self.parameters), self.options)

    def penalties(self, time: float) -> dict[str, Tensor]:
        return {"plane smoothness": plane_penalty(self.levels, self.options.penalty_weights)}

    @torch.no_grad()
    def extend(self, seen: tuple[float, float], soon: tuple[float, float]) -> None:
        """Copy the outermost trained time rows to the rows of the next window."""
        for level in self.levels:
            planes = level.time.data
            last = level.time.shape[1] - 1
            low = max(math.floor(seen[0] * last), 0)
            high = min(math.ceil(seen[1] * last), last)
            planes[:, max(math.floor(soon[0] * last), 0) : low] = planes[:, low, None]
            planes[:, high + 1 : math.ceil(soon[1] * last) + 1] = planes[:, high, None]


SPACE_FREQUENCIES = 10  # octaves of the encoding of positions
MLP_LR_DECAY = 0.002  # ratio of the last to the first learning rate
# This layer (counted from 0) gets the input again, in networks that are deep enough.
SKIP_LAYER = 5


class Mlp(DeformationField):
    """Offsets from a deep network on encoded position and time (Deformable-3DGS).

    Positions get no gradient through the network, as published. Unlike the paper, scales change in
    the logarithm, so that they stay positive. The last layer starts at zero.
    """

    def __init__(self, options: MlpField, setup: FieldSetup, generator: torch.Generator) -> None:
        self.options, self.setup = options, setup
        encoded_time = 1 + 2 * options.time_frequencies
        inputs = 3 * (1 + 2 * SPACE_FREQUENCIES) + (options.time_features or encoded_time)
        skip = SKIP_LAYER if options.depth > SKIP_LAYER else None
        self.decoder = Decoder(inputs, [options.width] * options.depth, options, skip=skip)
        weights = self.decoder.start_values(generator)
        if options.time_features:
            widths = [encoded_time, options.width, options.time_features]
            weights |= glorot_layers(pairwise(widths), generator, "time_")
        self.parameters = Parameters(weights, dict.fromkeys(weights, options.lr), MLP_LR_DECAY)

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        space = encode_frequencies(
            self.setup.normalize(select_rows(means.detach(), rows)), SPACE_FREQUENCIES
        )
        encoded_time = encode_frequencies(
            space.new_full((1, 1), time), self.options.time_frequencies
        )
        if self.options.time_features:
            encoded_time = perceptron(encoded_time, self.parameters.layers(2, "time_"))
        features = torch.cat([space, encoded_time.expand(len(space), -1)], dim=1)
        return split_heads(self.decoder(features, self.parameters), self.options)


def encode_frequencies(x: Tensor, num_frequencies: int) -> Tensor:
    """Return ``x`` (M, D) with sines and cosines at L octaves, (M, D * (1 + 2 L)) (NeRF)."""
    octaves = 2.0 ** torch.arange(num_frequencies, dtype=x.dtype, device=x.device)
    angles = (x[:, None, :] * octaves[:, None]).flatten(1)
    return torch.cat([x, angles.sin(), angles.cos()], dim=1)
