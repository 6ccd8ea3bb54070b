"""Named tensors trained by Adam, and the optimiser of Gaussians with its schedules."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.config import OptimConfig
from dyngs.core.state import Role, State, StateTensor, move_to_device, add_prefix, with_role
from dyngs.core.tensor_checks import require_tensor
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.ops.adam import AdamUpdate, Count, adam_steps_, seen_rows

MOMENTS = "exp_avg", "exp_avg_sq"
"""Prefixes of the moments' names in a state."""


@dataclass
class AdamState:
    """First and second moments of named tensors."""

    exp_avg: dict[str, Tensor]
    exp_avg_sq: dict[str, Tensor]

    @staticmethod
    def zero(tensors: Mapping[str, Tensor]) -> AdamState:
        """Return the moments before the first update of ``tensors``."""
        return AdamState(
            *({name: torch.zeros_like(x.detach()) for name, x in tensors.items()} for _ in MOMENTS)
        )

    @staticmethod
    def from_state(stored: Mapping[str, Tensor], tensors: Mapping[str, Tensor]) -> AdamState:
        """Return the moments of ``tensors`` from what ``state`` returned."""
        return AdamState(
            *(
                {name: _stored(stored, f"{part}.{name}", x) for name, x in tensors.items()}
                for part in MOMENTS
            )
        )

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
        self,
        name: str,
        x: Tensor,
        lr: float | Tensor,
        rows: Tensor | None = None,
        *,
        along_last_axis: bool = False,
    ) -> AdamUpdate | None:
        """Return the update of the leaf tensor ``x`` (N, ...), and drop its gradient; None where it
        has none.

        With ``along_last_axis`` only the values along the last axis are a row, so that little is
        left out of a large array.
        """
        grad = x.grad
        x.grad = None
        if grad is None:
            return None
        arrays = [x.detach(), grad, self.exp_avg[name], self.exp_avg_sq[name]]
        if along_last_axis and x.ndim > 1:
            arrays = [one.reshape(-1, x.shape[-1]) for one in arrays]
        return AdamUpdate(*arrays, lr=lr, rows=rows)

    def map(
        self, function: Callable[[Tensor], Tensor], names: Iterable[str] | None = None
    ) -> AdamState:
        """Return the moments with ``function`` applied to those of the named tensors; None: of
        all."""
        chosen = set(self.exp_avg if names is None else names)
        return AdamState(
            *(
                {name: function(x) if name in chosen else x for name, x in moments.items()}
                for moments in (self.exp_avg, self.exp_avg_sq)
            )
        )

    def state(self) -> State:
        first, second = (
            add_prefix(part, with_role(getattr(self, part), Role.TRAINING)) for part in MOMENTS
        )
        return first | second

    def to(self, device: torch.device | str) -> AdamState:
        return self.map(lambda x: x.to(device))


def _stored(
    tensors: Mapping[str, Tensor], name: str, like: Tensor, rows: int | None = None
) -> Tensor:
    """Return a copy of a stored tensor of the shape (but for the number of ``rows``), type and
    device of ``like``."""
    shape = like.shape if rows is None else (rows, *like.shape[1:])
    return require_tensor(name, tensors[name], tuple(shape), like.dtype).to(like.device).clone()


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
            return self._adam.update(name, x, lr, along_last_axis=True)
        return self._adam.update(name, x, lr, None if x.grad is None else seen_rows(x.grad))

    def apply_edit(self, role: Role, edit: TopologyEdit) -> Parameters:
        """Return the parameters after an edit of the Gaussians that ``role`` speaks of."""
        names = [name for name, own in self._roles.items() if own is role]
        moved = {name: edit.apply(self._tensors[name].detach()) for name in names}
        return self._with(moved, edit.apply_moments) if names else self

    def reorder(self, values: Mapping[str, Tensor], source: Tensor, is_new: Tensor) -> Parameters:
        """Return the parameters with other values for some tensors, and the moments of the old rows
        ``source``."""
        return self._with(values, lambda x: _moments_of(x, source, is_new))

    def values(self) -> dict[str, Tensor]:
        return {name: x.detach() for name, x in self._tensors.items()}

    def state(self) -> State:
        return {
            name: StateTensor(x, self._roles[name]) for name, x in self.values().items()
        } | self._adam.state()

    def with_state(
        self, tensors: Mapping[str, Tensor], rows: Mapping[str, int] | None = None
    ) -> Parameters:
        """Return what ``state`` returned as parameters like these, on their device.

        Where no moments are stored, as in files for drawing, they are 0.

        Args:
            rows: names of the tensors that have another number of rows than now, and what it must
                be.
        """
        lengths = rows or {}
        values = {
            name: _stored(tensors, name, x, lengths.get(name)) for name, x in self._tensors.items()
        }
        found = Parameters(values, self.rates, self.decay, self._roles)
        if any(name.startswith(MOMENTS) for name in tensors):
            found._adam = AdamState.from_state(tensors, values)
        return found

    def to(self, device: torch.device | str) -> Parameters:
        found = Parameters(move_to_device(self.values(), device), self.rates, self.decay, self._roles)
        found._adam = self._adam.to(device)
        return found

    def _with(
        self, values: Mapping[str, Tensor], moments: Callable[[Tensor], Tensor]
    ) -> Parameters:
        """Return the parameters with other ``values``, and their moments changed by ``moments``."""
        found = Parameters({}, self.rates, self.decay, self._roles)
        found._tensors = self._tensors | {name: _leaf(x) for name, x in values.items()}
        found._adam = self._adam.map(moments, values)
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

    def exclude_from_edit(self, result: EditResult, parameters: Gaussians) -> EditResult:
        """Return a change of the set without what it does to Gaussians that stay: they come last,
        as they were."""
        if self.rows is None:
            return result
        old = parameters.tensors()
        edit = result.edit or TopologyEdit.select(torch.ones_like(self.rows))
        goes = ~self.rows[edit.source]
        stays = torch.nonzero(self.rows)[:, 0]
        kept = TopologyEdit.select(stays)
        source = torch.cat([edit.source[goes], stays])
        is_new = torch.cat([edit.is_new[goes], kept.is_new])
        changes = {
            name: torch.cat([x[goes], kept.apply(old[name].detach())])
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
        frozen_harmonics: Tensor | None = None,
        skip_unseen_rows: Tensor | None = None,
        frozen_mask: FrozenMask | None = None,
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
        rows = None if frozen_mask is None or frozen_mask.rows is None else ~frozen_mask.rows
        if skip_unseen_rows is not None:
            seen = self._rows_with_gradient()[skip_unseen_rows]
            rows = seen.new_ones(len(self.parameters)) if rows is None else rows
            rows[skip_unseen_rows] &= seen
        rates: dict[str, float | Tensor] = {
            "means": lr_means,
            "quats": self.options.lr_quats,
            "log_scales": self.options.lr_scales,
            "logit_opacities": self.options.lr_opacities,
            "sh": self._harmonics_rates(),
        }
        if frozen_harmonics is not None and self.parameters.sh.grad is not None:
            self.parameters.sh.grad[frozen_harmonics, 1:] = 0
        updates = [
            self._adam.update(name, x, rates[name], rows)
            for name, x in self.parameters.tensors().items()
        ]
        if frozen_mask is not None and frozen_mask.shapes:
            updates = updates[-1:]  # of the harmonics
        return self._adam.steps_(updates, step=step, eps=ADAM_EPS)

    def apply(self, result: EditResult) -> None:
        """Change the set of Gaussians: parameters and moments of survivors move along, new rows
        start without moments.

        All parameters become new leaf tensors; gradients are dropped.
        """
        edit = result.edit
        moved = self.parameters.detach().tensors()
        if edit is not None:
            self._adam = self._adam.map(edit.apply_moments)
            rest = moved.keys() - result.changes.keys()
            moved |= {name: edit.apply(moved[name]) for name in rest}
        self._adam = self._adam.map(torch.zeros_like, result.zero_moments)
        self.parameters = _as_leaves(moved | result.changes)

    def drop_harmonics(self, base: Tensor, frozen_harmonics: Tensor) -> None:
        """Replace harmonics by a base colour, for good: rest and moments become zero; if they do
        for all, they go."""
        sh = self.parameters.sh.detach().clone()
        count = 1 if bool(frozen_harmonics.all()) else sh.shape[1]
        sh[frozen_harmonics, 0] = base[frozen_harmonics]
        rest = frozen_harmonics[:, None, None].repeat(1, sh.shape[1], 1)
        rest[:, 0] = False

        def dropped(x: Tensor) -> Tensor:
            return x.masked_fill(rest, 0)[:, :count].contiguous()

        self.parameters = _as_leaves({**self.parameters.tensors(), "sh": dropped(sh)})
        self._adam = self._adam.map(dropped, ["sh"])

    def to(self, device: torch.device | str) -> GaussianOptimizer:
        moved = GaussianOptimizer(self.parameters.detach().to(device=device), self.options)
        moved._adam = self._adam.to(device)
        return moved

    def state(self) -> State:
        return self._adam.state()

    def with_state(self, parameters: Gaussians, tensors: Mapping[str, Tensor]) -> GaussianOptimizer:
        """Return an optimizer of copies of ``parameters`` with the moments that ``state``
        returned."""
        # steps change them in place, and a checkpoint may share its memory with another trainer
        copies = Gaussians(**{name: x.detach().clone() for name, x in parameters.tensors().items()})
        optimizer = GaussianOptimizer(copies, self.options)
        optimizer._adam = AdamState.from_state(tensors, parameters.tensors())
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
        assert opacity_grad is not None
        assert means_grad is not None
        return (opacity_grad != 0) | seen_rows(means_grad)


def _as_leaves(tensors: dict[str, Tensor]) -> Gaussians:
    return Gaussians(**{name: _leaf(x) for name, x in tensors.items()})
