"""Initial weights of networks."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def glorot(fan_in: int, fan_out: int, generator: torch.Generator) -> Tensor:
    """Return (fan_out, fan_in) weights, uniform within sqrt(6 / (fan_in + fan_out)) (Glorot and
    Bengio 2010).

    Sampled on the CPU, so that they are the same on every device.
    """
    uniform = torch.rand((fan_out, fan_in), generator=generator, device="cpu")
    return (2 * uniform - 1) * math.sqrt(6 / (fan_in + fan_out))
