"""Named tensors trained by Adam, with their learning rates: fields, corrections of body fits,
colour networks."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from dyngs.core.state import Role, State, StateTensor, moved_to
from dyngs.core.tensor_checks import require_tensor
from dyngs.gaussians import TopologyEdit
from dyngs.gaussians.adam import MOMENTS, AdamState
from dyngs.ops.adam import AdamUpdate, Count, seen_rows

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
