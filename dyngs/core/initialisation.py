"""Initial weights of networks."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor


def glorot(fan_in: int, fan_out: int, generator: torch.Generator) -> Tensor:
    """Return (fan_out, fan_in) weights, uniform within sqrt(6 / (fan_in + fan_out)) (Glorot and
    Bengio 2010).

    Sampled on the CPU, so that they are the same on every device.
    """
    uniform = torch.rand((fan_out, fan_in), generator=generator, device="cpu")
    return (2 * uniform - 1) * math.sqrt(6 / (fan_in + fan_out))


def glorot_layers(
    sizes: Iterable[tuple[int, int]], generator: torch.Generator, prefix: str = ""
) -> dict[str, Tensor]:
    """Return ``glorot`` weights and zero biases by name of layers with these inputs and outputs."""
    values: dict[str, Tensor] = {}
    for i, (fan_in, fan_out) in enumerate(sizes):
        values[f"{prefix}weight{i}"] = glorot(fan_in, fan_out, generator)
        values[f"{prefix}bias{i}"] = torch.zeros(fan_out, device="cpu")
    return values
