"""Named tensors of a field with their Adam moments and learning rates."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from dyngs.ops.adam import adam_step_
from dyngs.tensor_checks import require_tensor


class LearnedTensors:
    """Leaf tensors that receive gradients, optimised in place by Adam.

    Args:
        tensors: name to start value.
        rates: name to learning rate at the first step.
        decay: last over first rate; log-linear between.
    """

    def __init__(self, tensors: Mapping[str, Tensor], rates: Mapping[str, float], decay: float = 1.0) -> None:
        self.decay = decay
        self._rates = dict(rates)
        self._tensors = {name: _leaf(x) for name, x in tensors.items()}
        self._exp_avg = {name: torch.zeros_like(x) for name, x in tensors.items()}
        self._exp_avg_sq = {name: torch.zeros_like(x) for name, x in tensors.items()}

    def __getitem__(self, name: str) -> Tensor:
        return self._tensors[name]

    def __contains__(self, name: str) -> bool:
        return name in self._tensors

    @property
    def num_values(self) -> int:
        """How many numbers are learned."""
        return sum(x.numel() for x in self._tensors.values())

    def step(self, step: int, progress: float, eps: float = 1e-15) -> int:
        """Rows left out for a gradient that is not finite; updates all tensors and drops the gradients.

        Args:
            step: number of this update, from 1.
            progress: 0 at the first update, 1 at the last; decides the rates.
        """
        left_out = 0
        progress = min(progress, 1.0)
        for name, x in self._tensors.items():
            if x.grad is None:
                continue
            flat, grad = _rows(x.detach()), _rows(x.grad)
            moments = _rows(self._exp_avg[name]), _rows(self._exp_avg_sq[name])
            lr = self._rates[name] * self.decay**progress if self.decay > 0 else self._rates[name] * (1 - progress)
            left_out += adam_step_(flat, grad, *moments, lr=lr, step=step, eps=eps)
            x.grad = None
        return left_out

    def rearrange(self, name: str, values: Tensor, source: Tensor, is_new: Tensor) -> None:
        """Exchange one tensor for ``values``; row i takes the moments of the old row ``source[i]``, a new one none."""
        for moments in (self._exp_avg, self._exp_avg_sq):
            moved = torch.zeros_like(values)
            moved[~is_new] = moments[name][source[~is_new]]
            moments[name] = moved
        self._tensors[name] = _leaf(values)

    def select(self, name: str, index: Tensor, is_new: Tensor) -> None:
        """Rearrange the rows of one tensor; moments of new rows start at zero."""
        self._tensors[name] = _leaf(self._tensors[name].detach()[index])
        for moments in (self._exp_avg, self._exp_avg_sq):
            moved = moments[name][index]
            moved[is_new] = 0
            moments[name] = moved

    def values(self) -> dict[str, Tensor]:
        """Name to value, detached."""
        return {name: x.detach() for name, x in self._tensors.items()}

    def state(self) -> dict[str, Tensor]:
        """Values and moments by name, for a checkpoint."""
        state = self.values()
        state |= {f"exp_avg.{name}": x for name, x in self._exp_avg.items()}
        return state | {f"exp_avg_sq.{name}": x for name, x in self._exp_avg_sq.items()}

    def load_state(self, state: Mapping[str, Tensor], rows: Mapping[str, int] | None = None) -> None:
        """Take over what ``state()`` returned.

        Args:
            state: names to values and moments.
            rows: names of the tensors that have another number of rows than now, and what it must be.

        Raises:
            KeyError: a tensor lacks.
            ValueError: one has another type or shape, or is not finite.
        """
        for name, x in self._tensors.items():
            shape = ((rows or {}).get(name, len(x)), *x.shape[1:])
            value, first, second = (
                require_tensor(f"{part}{name}", state[f"{part}{name}"], shape, x.dtype).clone()
                for part in ("", "exp_avg.", "exp_avg_sq.")
            )
            self._tensors[name], self._exp_avg[name], self._exp_avg_sq[name] = _leaf(value), first, second


def _leaf(x: Tensor) -> Tensor:
    return x.detach().contiguous().requires_grad_()


def _rows(x: Tensor) -> Tensor:
    """``x`` as rows for Adam, which leaves a row with a non-finite gradient out."""
    return x.reshape(-1, x.shape[-1]) if x.ndim > 1 else x
