"""A curve per Gaussian, without a network: a polynomial and a Fourier series in time.

For small motion and long clips (compare Li et al. 2024, spacetime Gaussians; Lin et al. 2024, Gaussian-Flow).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dyngs.config import TrajectoryField
from dyngs.deform.decoder import head_sizes, split_heads
from dyngs.deform.field import FieldSetup, NetworkField, Offsets, chosen
from dyngs.gaussians import TopologyEdit
from dyngs.gaussians.parameters import Parameters
from dyngs.state import Role

LR_OTHERS = 1e-3
"""Learning rate of all coefficients except those of positions."""
LR_DECAY = 0.01
"""Ratio of the last to the first learning rate."""


class Trajectory(NetworkField):
    """Offsets as sums of basis functions with coefficients per Gaussian, all zero at the start."""

    def __init__(self, options: TrajectoryField, setup: FieldSetup, generator: torch.Generator) -> None:
        self.options, self.setup = options, setup
        self.num_terms = options.polynomial + 2 * options.fourier
        sizes = head_sizes(options)
        tensors = {
            name: torch.zeros(setup.num_moving, self.num_terms, size, device="cpu") for name, size in sizes.items()
        }
        rates = dict.fromkeys(sizes, LR_OTHERS)
        rates["means"] = options.lr_means * setup.extent
        self.parameters = Parameters(tensors, rates, LR_DECAY, Role.PER_MOVING)

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        """See ``DeformationField.offsets``; ``means`` do not matter."""
        terms = basis(time, self.options.polynomial, self.options.fourier).to(means)
        curves = (chosen(self.parameters[name], rows) for name in head_sizes(self.options))
        parts = [torch.einsum("b,mbd->md", terms, x) for x in curves]
        return split_heads(torch.cat(parts, dim=1), self.options)

    def edited(self, edit: TopologyEdit) -> Trajectory:
        return self.with_parameters(self.parameters.edited(Role.PER_MOVING, edit))


def basis(time: float, polynomial: int, fourier: int) -> Tensor:
    """Return (polynomial + 2 fourier,) values at ``time`` in [0, 1], float64.

    Legendre polynomials of degree 1 and up on the whole clip, then sines and cosines of whole periods, less their mean
    over the clip (zero); amplitudes fall with frequency so that one learning rate suits all of them.
    """
    x = 2 * time - 1
    legendre = [1.0, x]
    for n in range(1, polynomial):
        legendre.append(((2 * n + 1) * x * legendre[n] - n * legendre[n - 1]) / (n + 1))
    values = legendre[1 : polynomial + 1]
    for k in range(1, fourier + 1):
        values += [math.sin(2 * math.pi * k * time) / k, math.cos(2 * math.pi * k * time) / k]
    return torch.tensor(values, dtype=torch.float64, device="cpu")
