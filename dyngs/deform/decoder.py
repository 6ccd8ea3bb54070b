"""The small network at the end of a field: features in, one number per degree of freedom out, zero
before training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from dyngs.core.initialisation import glorot
from dyngs.deform.field import Offsets
from dyngs.deform.keys import FieldSection
from dyngs.gaussians.parameters import Parameters
from dyngs.ops.perceptron import Layer, perceptron


class Decoder:
    """A multilayer perceptron whose last layer starts at zero; layer ``skip`` sees the features
    once more."""

    def __init__(
        self,
        num_inputs: int,
        hidden: Sequence[int],
        options: FieldSection,
        *,
        skip: int | None = None,
    ) -> None:
        self.widths = [num_inputs, *hidden, sum(head_sizes(options).values())]
        self.skip = skip

    def start_values(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Return weights after Glorot and Bengio 2010 and zero biases; the last layer all zero."""
        values: dict[str, Tensor] = {}
        last = len(self.widths) - 2
        for i in range(last + 1):
            fan_in = self.widths[i] + (self.widths[0] if i == self.skip else 0)
            fan_out = self.widths[i + 1]
            weight = glorot(fan_in, fan_out, generator)
            values[f"weight{i}"] = torch.zeros_like(weight) if i == last else weight
            values[f"bias{i}"] = torch.zeros(fan_out, device="cpu")
        return values

    def __call__(self, features: Tensor, parameters: Parameters) -> Tensor:
        layers = [
            Layer(parameters[f"weight{i}"], parameters[f"bias{i}"])
            for i in range(len(self.widths) - 1)
        ]
        return perceptron(features, layers, skip=self.skip)


def head_sizes(options: FieldSection) -> Mapping[str, int]:
    """Return the number of outputs of each head of ``Offsets`` by name, in order."""
    wanted = {
        "means": (3, True),
        "quats": (4, options.move_rotations),
        "log_scales": (3, options.move_scales),
        "logit_opacities": (1, options.move_opacities),
        "colors": (3, options.move_colors),
    }
    return {name: size for name, (size, is_on) in wanted.items() if is_on}


def split_heads(outputs: Tensor, options: FieldSection) -> Offsets:
    """Return the outputs (M, K) of the heads by name."""
    return offsets_of(outputs[:, :3], outputs[:, 3:], head_sizes(options))


def offsets_of(means: Tensor, values: Tensor, heads: Mapping[str, int]) -> Offsets:
    """Return offsets with ``means`` (M, 3), and the ``values`` (M, D) of all other ``heads`` by
    name."""
    sizes = {name: size for name, size in heads.items() if name != "means"}
    parts = dict(zip(sizes, values.split(list(sizes.values()), dim=1), strict=True))
    if "logit_opacities" in parts:
        parts["logit_opacities"] = parts["logit_opacities"][:, 0]
    return Offsets(means, **parts)
