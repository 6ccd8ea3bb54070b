"""Named tensors trained by Adam, with their learning rates: fields, corrections of body fits,
colour networks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import torch
from torch import Tensor

from dyngs.core.state import Role, State, StateTensor, moved_to, prefixed, with_role
from dyngs.core.tensor_checks import require_tensor
from dyngs.gaussians import TopologyEdit
from dyngs.ops.adam import AdamUpdate, Count, adam_steps_, seen_rows

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


Roles = Role | Mapping[str, Role]


class Parameters:
    """Leaf tensors that receive gradients, optimised in place by Adam.

    Args:
        decay: last over first rate; log-linear between. 0: rates fall linearly to 0.
        roles: of the tensors, one for all or by name.
    """

    def __init__(
        self,
        tensors: Mapping[str, Tensor],
        rates: Mapping[str, float],
        decay: float = 1.0,
        roles: Roles = Role.SHARED,
    ) -> None:
        self.decay, self.rates = decay, dict(rates)
        self._roles = dict.fromkeys(tensors, roles) if isinstance(roles, Role) else dict(roles)
        self._tensors = {name: _leaf(x) for name, x in tensors.items()}
        self._adam = AdamState.zero(tensors)

    def __getitem__(self, name: str) -> Tensor:
        return self._tensors[name]

    def get(self, name: str) -> Tensor | None:
        return self._tensors.get(name)

    def __contains__(self, name: str) -> bool:
        return name in self._tensors

    @property
    def leaves(self) -> list[Tensor]:
        return list(self._tensors.values())

    @property
    def num_values(self) -> int:
        return sum(x.numel() for x in self._tensors.values())

    def step(self, step: int, progress: float) -> Count:
        """Update all tensors, drop the gradients, and return the number of rows left out for bad
        gradients.

        Args:
            progress: 0 at the first update, 1 at the last; decides the rates.
        """
        progress = min(progress, 1.0)
        return self.update(step, self.decay**progress if self.decay > 0 else 1 - progress)

    def update(self, step: int, factor: float) -> Count:
        """As ``step``, with all rates multiplied by ``factor``."""
        updates = [
            self._update_of(name, x, self.rates[name] * factor) for name, x in self._tensors.items()
        ]
        return self._adam.steps_(updates, step=step)

    def _update_of(self, name: str, x: Tensor, lr: float) -> AdamUpdate | None:
        if self._roles[name] is not Role.PER_MOVING:
            return self._adam.update_along_last_axis(name, x, lr)
        return self._adam.update(name, x, lr, None if x.grad is None else seen_rows(x.grad))

    def edited(self, role: Role, edit: TopologyEdit) -> Parameters:
        """Return the parameters after an edit of the Gaussians that ``role`` speaks of."""
        names = [name for name, own in self._roles.items() if own is role]
        moved = {name: edit.apply(self._tensors[name].detach()) for name in names}
        return self._with(moved, edit.apply_moments) if names else self

    def rearranged(
        self, values: Mapping[str, Tensor], source: Tensor, is_new: Tensor
    ) -> Parameters:
        """Return the parameters with other values for some tensors, and the moments of the old rows
        ``source``."""
        return self._with(values, lambda x: _moments_of(x, source, is_new))

    def values(self) -> dict[str, Tensor]:
        return {name: x.detach() for name, x in self._tensors.items()}

    def state(self) -> State:
        return {
            name: StateTensor(x, self._roles[name]) for name, x in self.values().items()
        } | self._adam.state()

    def restored(
        self, tensors: Mapping[str, Tensor], rows: Mapping[str, int] | None = None
    ) -> Parameters:
        """Return what ``state`` returned as parameters like these, on their device.

        Where no moments are stored, as in files for drawing, they are 0.

        Args:
            rows: names of the tensors that have another number of rows than now, and what it must
                be.
        """
        values = {
            name: require_tensor(
                name, tensors[name], ((rows or {}).get(name, len(x)), *x.shape[1:]), x.dtype
            )
            .to(x.device)
            .clone()
            for name, x in self._tensors.items()
        }
        found = Parameters(values, self.rates, self.decay, self._roles)
        if any(name.startswith(tuple(f"{part}." for part in MOMENTS)) for name in tensors):
            found._adam = AdamState.restored(tensors, values)
        return found

    def to(self, device: torch.device | str) -> Parameters:
        found = Parameters(moved_to(self.values(), device), self.rates, self.decay, self._roles)
        found._adam = self._adam.to(device)
        return found

    def _with(
        self, values: Mapping[str, Tensor], moments: Callable[[Tensor], Tensor]
    ) -> Parameters:
        """Return the parameters with other ``values``, and their moments changed by ``moments``."""
        found = Parameters({}, self.rates, self.decay, self._roles)
        found._tensors = self._tensors | {name: _leaf(x) for name, x in values.items()}
        found._adam = self._adam.mapped(moments, values)
        return found


def _leaf(x: Tensor) -> Tensor:
    return x.detach().contiguous().requires_grad_()


def _moments_of(x: Tensor, source: Tensor, is_new: Tensor) -> Tensor:
    """Return the moments ``x`` of rows ``source``; those of new rows, whose source need not exist,
    are 0."""
    moved = x.new_zeros(len(source), *x.shape[1:])
    moved[~is_new] = x[source[~is_new]]
    return moved
