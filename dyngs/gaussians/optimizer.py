"""Adam for named tensors, and the optimiser of Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.config import OptimConfig
from dyngs.core.state import Role, State, StateTensor, add_prefix, move_to_device, with_role
from dyngs.core.tensor_checks import require_tensor
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.ops.adam import AdamUpdate, Count, adam_steps_, seen_rows
from dyngs.ops.perceptron import Layer

MOMENTS = "exp_avg", "exp_avg_sq"
"""Prefixes of the moments in a state dict."""


@dataclass
class AdamState:
    """First and second Adam moments of named tensors."""

    exp_avg: dict[str, Tensor]
    exp_avg_sq: dict[str, Tensor]

    @staticmethod
    def zero(tensors: Mapping[str, Tensor]) -> AdamState:
        """Return zero moments for ``tensors``."""
        return AdamState(
            *({name: torch.zeros_like(x.detach()) for name, x in tensors.items()} for _ in MOMENTS)
        )

    @staticmethod
    def from_state(stored: Mapping[str, Tensor], tensors: Mapping[str, Tensor]) -> AdamState:
        """Return the moments of ``tensors`` from a state that ``state`` returned."""
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
        """Apply ``steps_`` to one tensor; ``rows`` (N,) bool: rows to update, None: all."""
        return self.steps_([self.update(name, x, lr, rows)], step=step, eps=eps)

    def steps_(
        self,
        updates: Sequence[AdamUpdate | None],
        *,
        step: int,
        eps: float = 1e-15,
        betas: tuple[float, float] = (0.9, 0.999),
    ) -> Count:
        """Apply ``updates`` in place (None entries are ignored); return the number of skipped
        rows.

        Rows with a non-finite gradient are skipped. ``step`` counts from 1, for the bias
        correction.
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
        """Return the update of the leaf tensor ``x`` (N, ...) and clear its gradient; None without
        gradient.

        With ``along_last_axis`` a row is a slice along the last axis, so that one bad value skips
        little of a large array.
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
        """Apply ``function`` to the moments of the named tensors; None: all."""
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
    """Return a copy of a stored tensor with the shape, dtype and device of ``like``.

    ``rows``: number of rows, if it differs from ``like``.
    """
    shape = like.shape if rows is None else (rows, *like.shape[1:])
    return require_tensor(name, tensors[name], tuple(shape), like.dtype).to(like.device).clone()


Roles = Role | Mapping[str, Role]


class Parameters:
    """Leaf tensors that Adam optimises in place.

    Args:
        decay: ratio of the last to the first learning rate, of all tensors or of each by name;
            log-linear between. 0: linear decay to 0.
        roles: role of all tensors, or of each by name.
    """

    def __init__(
        self,
        tensors: Mapping[str, Tensor],
        rates: Mapping[str, float],
        decay: float | Mapping[str, float] = 1.0,
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

    def layers(self, count: int, prefix: str = "") -> list[Layer]:
        """Return the layers of a network whose weights and biases have this ``prefix``."""
        return [Layer(self[f"{prefix}weight{i}"], self[f"{prefix}bias{i}"]) for i in range(count)]

    @property
    def leaves(self) -> list[Tensor]:
        return list(self._tensors.values())

    @property
    def num_values(self) -> int:
        return sum(x.numel() for x in self._tensors.values())

    def step(self, step: int, progress: float) -> Count:
        """Update all tensors and clear the gradients; return the number of skipped rows.

        Args:
            progress: 0 at the first update, 1 at the last; sets the learning rates.
        """
        progress = min(progress, 1.0)
        factors: dict[str, float] = {}
        for name in self._tensors:
            decay = self.decay[name] if isinstance(self.decay, Mapping) else self.decay
            factors[name] = decay**progress if decay > 0 else 1 - progress
        return self.update(step, factors)

    def update(self, step: int, factors: Mapping[str, float]) -> Count:
        """Update all tensors with their learning rates times ``factors``; see ``step``."""
        updates: list[AdamUpdate | None] = []
        for name, x in self._tensors.items():
            is_moving = self._roles[name] is Role.PER_MOVING
            rows = seen_rows(x.grad) if is_moving and x.grad is not None else None
            lr = self.rates[name] * factors[name]
            updates.append(self._adam.update(name, x, lr, rows, along_last_axis=rows is None))
        return self._adam.steps_(updates, step=step)

    def apply_edit(self, role: Role, edit: TopologyEdit) -> Parameters:
        """Return the parameters after a topology edit of the rows with this ``role``."""
        names = [name for name, own in self._roles.items() if own is role]
        moved = {name: edit.apply(self._tensors[name].detach()) for name in names}
        return self._with(moved, edit.apply_moments) if names else self

    def reorder(self, values: Mapping[str, Tensor], source: Tensor, is_new: Tensor) -> Parameters:
        """Return the parameters with new ``values`` for some tensors and moments gathered from
        ``source``."""

        def moments(x: Tensor) -> Tensor:
            # The source of new rows may not exist.
            moved = x.new_zeros(len(source), *x.shape[1:])
            moved[~is_new] = x[source[~is_new]]
            return moved

        return self._with(values, moments)

    def values(self) -> dict[str, Tensor]:
        return {name: x.detach() for name, x in self._tensors.items()}

    def state(self) -> State:
        return {
            name: StateTensor(x, self._roles[name]) for name, x in self.values().items()
        } | self._adam.state()

    def with_state(
        self, tensors: Mapping[str, Tensor], rows: Mapping[str, int] | None = None
    ) -> Parameters:
        """Return these parameters with the values and moments in ``tensors``, on the same device.

        Moments that are not stored (files for rendering only) are 0.

        Args:
            rows: required number of rows by tensor name, where it differs from the current one.
        """
        lengths = rows or {}
        values = {
            name: _stored(tensors, name, x, lengths.get(name)) for name, x in self._tensors.items()
        }
        restored = Parameters(values, self.rates, self.decay, self._roles)
        if any(name.startswith(MOMENTS) for name in tensors):
            restored._adam = AdamState.from_state(tensors, values)
        return restored

    def to(self, device: torch.device | str) -> Parameters:
        moved = Parameters(
            move_to_device(self.values(), device), self.rates, self.decay, self._roles
        )
        moved._adam = self._adam.to(device)
        return moved

    def _with(
        self, values: Mapping[str, Tensor], moments: Callable[[Tensor], Tensor]
    ) -> Parameters:
        """Return the parameters with new ``values`` and their moments mapped by ``moments``."""
        changed = Parameters({}, self.rates, self.decay, self._roles)
        changed._tensors = self._tensors | {name: _leaf(x) for name, x in values.items()}
        changed._adam = self._adam.map(moments, values)
        return changed


def _leaf(x: Tensor) -> Tensor:
    return x.detach().contiguous().requires_grad_()


ADAM_EPS = 1e-15


@dataclass(frozen=True)
class FrozenMask:
    """Parameters that are frozen during training.

    ``rows`` (N,) bool: frozen Gaussians; None: none. With ``shapes`` everything but colour is
    frozen.
    """

    rows: Tensor | None = None
    shapes: bool = False

    def exclude_from_edit(self, result: EditResult, parameters: Gaussians) -> EditResult:
        """Remove frozen Gaussians from an edit; they are appended unchanged after other rows."""
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
    """Optimiser of N Gaussians.

    Attributes:
        parameters: leaf tensors; ``apply`` replaces them.
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
        frozen_mask: FrozenMask = FrozenMask(),
    ) -> Count:
        """Update the parameters and clear the gradients; return the number of skipped rows.

        Args:
            frozen_harmonics: (N,) bool, Gaussians of which only the base colour is updated; None:
                none.
            skip_unseen_rows: (M,) indices of Gaussians that are updated only if they received a
                gradient; None: none.
            frozen_mask: parameters that are not updated at all.
        """
        rows = None if frozen_mask.rows is None else ~frozen_mask.rows
        if skip_unseen_rows is not None:
            opacity_grad = self.parameters.logit_opacities.grad
            means_grad = self.parameters.means.grad
            assert opacity_grad is not None
            assert means_grad is not None
            # The gradient by opacity alone vanishes at full opacity.
            seen = ((opacity_grad != 0) | seen_rows(means_grad))[skip_unseen_rows]
            rows = seen.new_ones(len(self.parameters)) if rows is None else rows
            rows[skip_unseen_rows] &= seen
        # one per SH coefficient and channel, on the CPU
        num_terms = self.parameters.sh.shape[1]
        harmonics_rates = torch.full((num_terms, 3), self.options.lr_sh_rest, device="cpu")
        harmonics_rates[0] = self.options.lr_sh_dc
        rates: dict[str, float | Tensor] = {
            "means": lr_means,
            "quats": self.options.lr_quats,
            "log_scales": self.options.lr_scales,
            "logit_opacities": self.options.lr_opacities,
            "sh": harmonics_rates.reshape(-1),
        }
        if frozen_harmonics is not None and self.parameters.sh.grad is not None:
            self.parameters.sh.grad[frozen_harmonics, 1:] = 0
        updates = [
            self._adam.update(name, x, rates[name], rows)
            for name, x in self.parameters.tensors().items()
        ]
        if frozen_mask.shapes:
            updates = updates[-1:]  # only the SH coefficients
        return self._adam.steps_(updates, step=step, eps=ADAM_EPS)

    def apply(self, result: EditResult) -> None:
        """Apply a topology edit: parameters and moments are gathered, new rows get zero moments.

        All parameters become new leaf tensors without gradients.
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
        """Replace SH by a base colour: higher coefficients and their moments become 0.

        If that holds for all Gaussians, the coefficients are removed.
        """
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
        """Return an optimiser of copies of ``parameters`` with the moments in ``tensors``."""
        # Steps update in place, and a checkpoint may share memory with another trainer.
        copies = Gaussians(**{name: x.detach().clone() for name, x in parameters.tensors().items()})
        optimizer = GaussianOptimizer(copies, self.options)
        optimizer._adam = AdamState.from_state(tensors, parameters.tensors())
        return optimizer


def _as_leaves(tensors: dict[str, Tensor]) -> Gaussians:
    return Gaussians(**{name: _leaf(x) for name, x in tensors.items()})
