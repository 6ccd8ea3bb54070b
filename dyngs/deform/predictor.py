"""Predictor of view- and time-dependent deformation of 4D Gaussians (MEGA, Zhang et al. 2024).

F(mean and its time, view direction, time) returns factors of the mean, the scales and both
rotations, so that one Gaussian serves a longer part of the clip. No code was released: the number
of octaves, the widths after the branches and the centre of the products are our choice.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from dyngs.core.initialisation import glorot_layers
from dyngs.deform.networks import encode_frequencies
from dyngs.gaussians.optimizer import Parameters
from dyngs.ops.perceptron import perceptron

OCTAVES = 6  # of all encodings; 39 numbers of a direction and 13 of a time, as in a figure
BRANCHES = {"means": 4, "directions": 3, "times": 1}  # inputs before their encoding
FEATURES = 30  # outputs of each branch
NUM_FACTORS = 16
LR, LR_DECAY = 8e-4, 0.002  # first learning rate, and ratio of the last to it
WEIGHT_DECAY = 1e-6


def start_values(width: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Return Glorot weights and zero biases; the last layer is zero, so that all factors are 1."""
    widths = {name: [x * (1 + 2 * OCTAVES), width, FEATURES] for name, x in BRANCHES.items()}
    widths["joined"] = [FEATURES * len(BRANCHES), width, width, NUM_FACTORS]
    values: dict[str, Tensor] = {}
    for name, sizes in widths.items():
        values |= glorot_layers(pairwise(sizes), generator, f"{name}_")
    values["joined_weight2"].zero_()
    return values


def predict_changes(
    parameters: Parameters, means: Tensor, times: Tensor, directions: Tensor | None, now: Tensor
) -> Tensor:
    """Return the factors minus 1 (M, 16) of M Gaussians at the time ``now``.

    Their order: mean (3), its time, scales (3), scale along time, left and right rotation (4 each).

    Args:
        means: (M, 3) means, -1 to 1 in the box of the motion.
        times: (M, 1) mean times in clips.
        directions: (M, 3) unit vectors from the camera; None: no camera, with a zero encoding.
        now: (1, 1), or (M, 1) with a time for each Gaussian.
    """

    def evaluate(name: str, x: Tensor, num_layers: int = 2) -> Tensor:
        return perceptron(x, parameters.layers(num_layers, f"{name}_")).expand(len(means), -1)

    view = means[:1] if directions is None else directions
    inputs = torch.cat([means, 2 * times - 1], dim=1), view, 2 * now - 1
    encoded = [encode_frequencies(x, OCTAVES) for x in inputs]
    if directions is None:
        encoded[1] = torch.zeros_like(encoded[1])
    features = [evaluate(name, x) for name, x in zip(BRANCHES, encoded, strict=True)]
    return evaluate("joined", torch.cat(features, dim=1), 3)
