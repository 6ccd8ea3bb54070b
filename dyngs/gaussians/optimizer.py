"""Named tensors trained by Adam, and the optimiser of Gaussians with its schedules."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.config import OptimConfig
from dyngs.core.state import Role, State, StateTensor, moved_to, prefixed, with_role
from dyngs.core.tensor_checks import require_tensor
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
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


ADAM_EPS = 1e-15


@dataclass(frozen=True)
class FrozenMask:
    """What training leaves as it is: Gaussians (N,) bool, None: none; with ``shapes`` all but the
    colours of all."""

    rows: Tensor | None = None
    shapes: bool = False

    def grown(self, result: EditResult, parameters: Gaussians) -> EditResult:
        """Return a change of the set without what it does to Gaussians that stay: they come last,
        as they were."""
        if self.rows is None:
            return result
        old = parameters.tensors()
        if result.edit is None:
            shown = {
                name: self.rows.reshape(-1, *[1] * (x.ndim - 1))
                for name, x in result.changes.items()
            }
            changes = {
                name: torch.where(shown[name], old[name].detach(), x)
                for name, x in result.changes.items()
            }
            return replace(result, changes=changes)
        goes = ~self.rows[result.edit.source]
        stays = torch.nonzero(self.rows)[:, 0]
        source = torch.cat([result.edit.source[goes], stays])
        is_new = torch.cat([result.edit.is_new[goes], torch.zeros_like(stays, dtype=torch.bool)])
        changes = {
            name: torch.cat([x[goes], old[name].detach()[stays]])
            for name, x in result.changes.items()
        }
        return replace(result, edit=TopologyEdit(source, is_new), changes=changes)


class GaussianOptimizer:
    """The parameters of N Gaussians and their Adam moments.

    Attributes:
        parameters: leaf tensors that receive gradients; exchanged for new ones by ``apply``.
    """

    def __init__(self, gaussians: Gaussians, options: OptimConfig) -> None:
        self.options = options
        self.parameters = _as_leaves(gaussians.tensors())
        self._adam = AdamState.zero(gaussians.tensors())

    def step(
        self,
        step: int,
        lr_means: float,
        *,
        frozen_rest: Tensor | None = None,
        resting: Tensor | None = None,
        still: FrozenMask | None = None,
    ) -> Count:
        """Update the parameters, drop the gradients, and return the number of rows left out for bad
        gradients.

        Args:
            frozen_rest: (N,) bool, Gaussians of whose harmonics only the base colour is updated;
                None: none.
            resting: (M,) indices of Gaussians that are only updated if they received a gradient;
                None: none.
            still: what keeps parameters and moments whatever it receives.
        """
        rows: Tensor | None = None
        if resting is not None:
            rows = torch.ones(len(self.parameters), dtype=torch.bool, device=resting.device)
            rows[resting] = self._rows_with_gradient()[resting]
        if still is not None and still.rows is not None:
            rows = ~still.rows if rows is None else rows & ~still.rows
        rates: dict[str, float | Tensor] = {
            "means": lr_means,
            "quats": self.options.lr_quats,
            "log_scales": self.options.lr_scales,
            "logit_opacities": self.options.lr_opacities,
            "sh": self._harmonics_rates(),
        }
        if frozen_rest is not None and self.parameters.sh.grad is not None:
            self.parameters.sh.grad[frozen_rest, 1:] = 0
        updates = [
            self._adam.update(name, x, rates[name], rows)
            for name, x in self.parameters.tensors().items()
        ]
        if still is not None and still.shapes:
            updates = updates[-1:]  # of the harmonics
        return self._adam.steps_(updates, step=step, eps=ADAM_EPS)

    def apply(self, result: EditResult) -> None:
        """Change the set of Gaussians: parameters and moments of survivors move along, new rows
        start without moments.

        All parameters become new leaf tensors; gradients are dropped.
        """
        edit = result.edit
        moved = {}
        if edit is not None:
            self._adam = self._adam.mapped(edit.apply_moments)
        self._adam = self._adam.mapped(torch.zeros_like, result.zero_moments)
        for name, x in self.parameters.tensors().items():
            if name in result.changes:
                moved[name] = result.changes[name]
            else:
                moved[name] = x if edit is None else edit.apply(x.detach())
        self.parameters = _as_leaves(moved)

    def drop_rest(self, base: Tensor, frozen_rest: Tensor) -> None:
        """Replace harmonics by a base colour, for good: rest and moments become zero; if they do
        for all, they go."""
        chosen = frozen_rest[:, None, None]
        sh = self.parameters.sh.detach()
        plain = torch.cat([base[:, None], torch.zeros_like(sh[:, 1:])], dim=1)
        count = 1 if bool(frozen_rest.all()) else sh.shape[1]
        self.parameters = _as_leaves(
            {**self.parameters.tensors(), "sh": torch.where(chosen, plain, sh)[:, :count]}
        )
        self._adam = self._adam.mapped(
            lambda x: torch.cat([x[:, :1], torch.where(chosen, 0.0, x[:, 1:])], dim=1)[
                :, :count
            ].contiguous(),
            ["sh"],
        )

    def to(self, device: torch.device | str) -> GaussianOptimizer:
        moved = GaussianOptimizer(self.parameters.detach().to(device=device), self.options)
        moved._adam = self._adam.to(device)
        return moved

    def state(self) -> State:
        return self._adam.state()

    def restored(self, parameters: Gaussians, tensors: Mapping[str, Tensor]) -> GaussianOptimizer:
        """Return an optimizer of copies of ``parameters`` with the moments that ``state``
        returned."""
        # steps change them in place, and a checkpoint may share its memory with another trainer
        copies = Gaussians(**{name: x.detach().clone() for name, x in parameters.tensors().items()})
        optimizer = GaussianOptimizer(copies, self.options)
        optimizer._adam = AdamState.restored(tensors, parameters.tensors())
        return optimizer

    def _harmonics_rates(self) -> Tensor:
        """Return (K * 3,) one rate per coefficient, on the CPU."""
        rates = torch.full((self.parameters.sh.shape[1], 3), self.options.lr_sh_rest, device="cpu")
        rates[0] = self.options.lr_sh_dc
        return rates.reshape(-1)

    def _rows_with_gradient(self) -> Tensor:
        """Return (N,) bool; opacity or position: a Gaussian at full opacity gets no gradient on its
        opacity alone."""
        opacity_grad = self.parameters.logit_opacities.grad
        means_grad = self.parameters.means.grad
        if opacity_grad is None or means_grad is None:
            return torch.ones(
                len(self.parameters), dtype=torch.bool, device=self.parameters.means.device
            )
        return (opacity_grad != 0) | seen_rows(means_grad)


def _as_leaves(tensors: dict[str, Tensor]) -> Gaussians:
    return Gaussians(
        **{name: x.detach().contiguous().requires_grad_() for name, x in tensors.items()}
    )
