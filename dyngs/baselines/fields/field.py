"""What all fields have in common: what their rays see, and small pieces of their networks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dyngs.core.state import State
from dyngs.ops.perceptron import Layer, perceptron
from dyngs.ops.rays import Rays, Space

LARGEST_EXPONENT = 15.0
TIME_OCTAVES = 4
TIME = 1 + 2 * TIME_OCTAVES
"""Numbers that a time in [0, 1] is encoded in."""
PUBLISHED_HALF = 1.5
"""Half the side of the cube of published figures: densities are per unit of a world in which the
cube is as large."""


@dataclass(frozen=True)
class Seen:
    """What R rays see, before black."""

    colour: Tensor  # (R, 3)
    transmittance: Tensor  # (R,)
    depth: Tensor  # (R,) sum of weight times the distance along the ray
    num_samples: int  # that were taken
    coarse: Seen | None = None  # by the coarse network, where there is one


class Field(ABC):
    """A radiance field; its tensors are leaves while it is trained.

    Attributes:
        space: where it has a density.
        sees_time: it differs from time to time.
    """

    space: Space
    sees_time: bool

    @abstractmethod
    def seen(self, rays: Rays, time: float, *, near: float, shifts: Tensor | None = None) -> Seen:
        """Return what rays see at ``time``; differentiable in the parameters.

        Args:
            near: what is nearer is not drawn, world units.
            shifts: (R, K) random numbers in [0, 1) that place the samples, see ``num_shifts``;
                None: evenly.
        """

    @property
    @abstractmethod
    def num_shifts(self) -> int:
        """K: random numbers that a ray needs in training."""

    @property
    @abstractmethod
    def parameters(self) -> Mapping[str, Tensor]:
        """All that is learned, by name."""

    @abstractmethod
    def densities(self, points: Tensor, time: float) -> Tensor:
        """Return (M,) densities, per world unit, at points (M, 3) of the world."""

    def may_hold(self, points: Tensor) -> Tensor:
        """Return (M,) bool: whether there may be anything at points (M, 3) of the world, before
        looking."""
        return torch.ones(len(points), dtype=torch.bool, device=points.device)

    @abstractmethod
    def colours(self, points: Tensor, directions: Tensor, time: float) -> Tensor:
        """Return (M, 3) colours of points (M, 3) of the world, seen along unit directions (M,
        3)."""

    @abstractmethod
    def state(self) -> State:
        """Return its tensors by name, with their role."""


class _TruncatedExp(torch.autograd.Function):
    """exp, whose gradient is that of ``LARGEST_EXPONENT`` beyond it (Instant-NGP)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.exp()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (x,) = ctx.saved_tensors
        return grad * x.clamp(max=LARGEST_EXPONENT).exp()


def truncated_exp(x: Tensor) -> Tensor:
    """Return exp(x), whose gradient does not grow beyond exp(15)."""
    result: Tensor = _TruncatedExp.apply(x)  # pyright: ignore[reportAssignmentType]
    return result


def encoded(x: Tensor, octaves: int) -> Tensor:
    """Return (M, D (1 + 2 octaves)): x, then the sines and cosines of 2^k x of each octave k,
    without pi (NeRF)."""
    parts = [x]
    for k in range(octaves):
        parts += [(2.0**k * x).sin(), (2.0**k * x).cos()]
    return torch.cat(parts, 1)


def with_time(x: Tensor, time: float) -> Tensor:
    """Return (M, K + TIME): the inputs (M, K) of a network, and ``time``, encoded (T-NeRF)."""
    when = encoded(x.new_full((1, 1), time), TIME_OCTAVES)
    return torch.cat([x, when.expand(len(x), -1)], 1)


def network(x: Tensor, weights: Sequence[Tensor]) -> Tensor:
    """Return (M, out) outputs of a perceptron without biases."""
    return perceptron(x, [Layer(weight, weight.new_zeros(len(weight))) for weight in weights])
