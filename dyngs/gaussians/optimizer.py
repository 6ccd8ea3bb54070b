"""Adam over everything that is stored per Gaussian, following changes of the set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.config import OptimConfig
from dyngs.core.state import State
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.parameters import AdamState
from dyngs.ops.adam import Count, seen_rows

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
