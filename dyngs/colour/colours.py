"""How Gaussians are coloured while they are trained: what `Trainer` asks of every ``colour.kind``."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from dyngs.colour.network import ColourNetwork, Frame
from dyngs.config import ColourSection, NetworkColour
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.ops.adam import adam_step_
from dyngs.ops.perceptron import Layer
from dyngs.ops.shading import num_inputs
from dyngs.rendering import Shader
from dyngs.tensor_checks import require_tensor

_MILESTONES = (1 / 6, 1 / 2, 5 / 6)
"""Shares of a run after which the network's rate is divided by 3 (MEGA: 5k, 15k and 25k of 30k steps)."""


class Colours:
    """Harmonics as they are stored: nothing to learn beside them."""

    def __init__(self, options: ColourSection) -> None:
        self.entropy_weight = options.opacity_entropy

    def shader(self, time: float | None, frame: Frame | None) -> Shader | None:
        """What colours the Gaussians of a picture; None: their harmonics."""
        return None

    def penalties(self, parameters: Gaussians) -> dict[str, Tensor]:
        """Differentiable regularizers, weighted, by name."""
        if self.entropy_weight == 0:
            return {}
        return {"opacity entropy": self.entropy_weight * opacity_entropy(parameters.logit_opacities)}

    def holds_out(self, index: int, step: int) -> bool:
        """Whether training view ``index`` must not be trained on in ``step``."""
        return False

    def measures_after(self, step: int) -> bool:
        """Whether it is measured after ``step`` where harmonics pay."""
        return False

    def frozen_rest(self) -> Tensor | None:
        """(N,) bool, Gaussians whose harmonics stay zero but for the base colour; None: of none."""
        return None

    def follow(self, edit: TopologyEdit) -> None:
        """Follow a change of the set of Gaussians."""

    def after_step(self, step: int) -> int:
        """Optimize what is learned beside the harmonics; the number of values left out for bad gradients."""
        return 0

    def state(self) -> dict[str, Tensor]:
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Take over what ``state()`` returned. Raises KeyError if something is missing."""


class NetworkColours(Colours):
    """A network that all Gaussians share, learned by Adam.

    Args:
        options: size and rate.
        steps: length of the run.
        box: (2, 3), see ``ColourNetwork``.
        sees_time: time is an input.
        generator: of the first weights.
    """

    def __init__(
        self, options: NetworkColour, steps: int, box: Tensor, generator: torch.Generator, *, sees_time: bool
    ) -> None:
        super().__init__(options)
        self.options, self.steps, self.box, self.sees_time = options, steps, box, sees_time
        inputs = num_inputs(sees_time=sees_time, sees_normals=options.normals)
        widths = [inputs, *[options.width] * options.depth, 3]
        self._learned = {name: x.requires_grad_() for name, x in _start_values(widths, generator).items()}
        self._exp_avg = {name: torch.zeros_like(x.detach()) for name, x in self._learned.items()}
        self._exp_avg_sq = {name: torch.zeros_like(x.detach()) for name, x in self._learned.items()}

    @property
    def network(self) -> ColourNetwork:
        """As it is now; differentiable."""
        count = self.options.depth + 1
        layers = (Layer(self._learned[f"weight{i}"], self._learned[f"bias{i}"]) for i in range(count))
        return ColourNetwork(tuple(layers), self.box, self.sees_time, self.options.normals)

    def shader(self, time: float | None, frame: Frame | None) -> Shader:
        """The network's colours."""
        return self.network.shader(time, frame)

    def after_step(self, step: int) -> int:
        """How many weights were left out for a gradient that is not finite; updates them all."""
        left_out = 0
        lr = self.options.lr * rate_factor(step, self.steps, self.options.warm_up)
        for name, x in self._learned.items():
            if x.grad is not None:
                moments = self._exp_avg[name].view(-1), self._exp_avg_sq[name].view(-1)
                left_out += adam_step_(x.detach().view(-1), x.grad.reshape(-1), *moments, lr=lr, step=step)
                x.grad = None
        return left_out

    def state(self) -> dict[str, Tensor]:
        """Weights, what their inputs are, and Adam's moments; ``network_of`` reads the first two."""
        state = {name: x.detach() for name, x in self._learned.items()}
        state |= {"box": self.box, "sees": torch.tensor([self.sees_time, self.options.normals])}
        state |= {f"exp_avg.{name}": x for name, x in self._exp_avg.items()}
        return state | {f"exp_avg_sq.{name}": x for name, x in self._exp_avg_sq.items()}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self.box = require_tensor("box", state["box"], (2, 3), None)
        for name, x in self._learned.items():
            value, *moments = (
                require_tensor(f"{part}{name}", state[f"{part}{name}"], tuple(x.shape), x.dtype).clone()
                for part in ("", "exp_avg.", "exp_avg_sq.")
            )
            self._learned[name] = value.requires_grad_()
            self._exp_avg[name], self._exp_avg_sq[name] = moments


def opacity_entropy(logits: Tensor) -> Tensor:
    """The mean of -o ln o over opacities o with ``logits`` (N,), of which there may be none (Zhang et al. 2024).

    It is largest at o = 1/e: what is fainter is pushed towards 0, what is more opaque towards 1. The gradient by a
    logit, -(ln o + 1) o (1 - o), is finite everywhere.
    """
    if not len(logits):
        return logits.sum()
    return -(logits.sigmoid() * logsigmoid(logits)).mean()


def rate_factor(step: int, steps: int, warm_up: int) -> float:
    """What the rate of ``step``, from 1, is multiplied by: a linear warm-up, then a third after each milestone."""
    passed = sum(step > share * steps for share in _MILESTONES)
    return min(1.0, step / warm_up) / 3**passed


def _start_values(widths: list[int], generator: torch.Generator) -> dict[str, Tensor]:
    """Weights by Glorot and Bengio 2010 and zero biases; the last layer all zero, so that nothing is added at first."""
    values: dict[str, Tensor] = {}
    for i, (fan_in, fan_out) in enumerate(pairwise(widths)):
        bound = 0.0 if i == len(widths) - 2 else math.sqrt(6 / (fan_in + fan_out))
        values[f"weight{i}"] = (2 * torch.rand((fan_out, fan_in), generator=generator) - 1) * bound
        values[f"bias{i}"] = torch.zeros(fan_out)
    return values
