"""Moments of Adam (Kingma and Ba 2015) for named tensors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import torch
from torch import Tensor

from dyngs.core.state import Role, State, moved_to, prefixed, with_role
from dyngs.core.tensor_checks import require_tensor
from dyngs.ops.adam import AdamUpdate, Count, adam_steps_

MOMENTS = "exp_avg", "exp_avg_sq"
"""Prefixes of the moments' names in a state."""


class AdamState:
    """First and second moments of named tensors."""

    def __init__(self, exp_avg: dict[str, Tensor], exp_avg_sq: dict[str, Tensor]) -> None:
        self.exp_avg, self.exp_avg_sq = exp_avg, exp_avg_sq

    @staticmethod
    def zero(tensors: Mapping[str, Tensor]) -> AdamState:
        """Return the moments before the first update of ``tensors``."""
        first, second = (
            {name: torch.zeros_like(x.detach()) for name, x in tensors.items()} for _ in MOMENTS
        )
        return AdamState(first, second)

    @staticmethod
    def restored(stored: Mapping[str, Tensor], tensors: Mapping[str, Tensor]) -> AdamState:
        """Return the moments of ``tensors`` from what ``state`` returned."""
        first, second = (
            {
                name: require_tensor(
                    f"{part}.{name}", stored[f"{part}.{name}"], tuple(x.shape), x.dtype
                )
                .to(x.device)
                .clone()
                for name, x in tensors.items()
            }
            for part in MOMENTS
        )
        return AdamState(first, second)

    def step_(
        self,
        name: str,
        x: Tensor,
        *,
        lr: float | Tensor,
        step: int,
        eps: float = 1e-15,
        rows: Tensor | None = None,
    ) -> Count:
        """As ``steps_`` of one tensor, of which only the ``rows`` (N,) bool are updated; None:
        all."""
        return self.steps_([self.update(name, x, lr, rows)], step=step, eps=eps)

    def steps_(
        self,
        updates: Sequence[AdamUpdate | None],
        *,
        step: int,
        eps: float = 1e-15,
        betas: tuple[float, float] = (0.9, 0.999),
    ) -> Count:
        """Do the ``updates`` in place, those that are None left out, and return the number of rows
        left out.

        Rows whose gradient is not finite are left out. ``step``: the number of this update, from 1,
        for the bias correction.
        """
        wanted = [x for x in updates if x is not None]
        return adam_steps_(wanted, step=step, eps=eps, betas=betas) if wanted else 0

    def update(
        self, name: str, x: Tensor, lr: float | Tensor, rows: Tensor | None = None
    ) -> AdamUpdate | None:
        """Return the update of the leaf tensor ``x`` (N, ...), and drop its gradient; None where it
        has none."""
        grad = x.grad
        x.grad = None
        if grad is None:
            return None
        return AdamUpdate(x.detach(), grad, self.exp_avg[name], self.exp_avg_sq[name], lr, rows)

    def update_along_last_axis(self, name: str, x: Tensor, lr: float) -> AdamUpdate | None:
        """As ``update``; only the values along the last axis are a row, so that little is left out
        of a large array."""
        grad = x.grad
        x.grad = None
        if grad is None:
            return None
        first = _rows(self.exp_avg[name])
        second = _rows(self.exp_avg_sq[name])
        return AdamUpdate(_rows(x.detach()), _rows(grad), first, second, lr)

    def mapped(
        self, function: Callable[[Tensor], Tensor], names: Iterable[str] | None = None
    ) -> AdamState:
        """Return the moments with ``function`` applied to those of the named tensors; None: of
        all."""
        chosen = set(self.exp_avg if names is None else names)
        first, second = (
            {name: function(x) if name in chosen else x for name, x in moments.items()}
            for moments in (self.exp_avg, self.exp_avg_sq)
        )
        return AdamState(first, second)

    def state(self) -> State:
        parts = zip(MOMENTS, (self.exp_avg, self.exp_avg_sq), strict=True)
        return {
            k: x
            for part, moments in parts
            for k, x in prefixed(part, with_role(moments, Role.TRAINING)).items()
        }

    def to(self, device: torch.device | str) -> AdamState:
        return AdamState(moved_to(self.exp_avg, device), moved_to(self.exp_avg_sq, device))


def _rows(x: Tensor) -> Tensor:
    return x.reshape(-1, x.shape[-1]) if x.ndim > 1 else x
