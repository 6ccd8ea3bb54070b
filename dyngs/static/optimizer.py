"""Adam over everything that is stored per Gaussian, following changes of the set."""

from __future__ import annotations

import torch
from torch import Tensor

from dyngs.config import OptimConfig
from dyngs.gaussians import Gaussians
from dyngs.ops.adam import adam_step_, seen_rows
from dyngs.static.densify import EditResult
from dyngs.tensor_checks import require_tensor

PARTS = "gaussians", "exp_avg", "exp_avg_sq"
"""Of a state: parameters and moments."""


class GaussianOptimizer:
    """The parameters of N Gaussians and their Adam moments.

    Attributes:
        parameters: leaf tensors that receive gradients; exchanged for new ones by ``apply``.
    """

    def __init__(self, gaussians: Gaussians, options: OptimConfig) -> None:
        self.options = options
        self.parameters = _as_leaves(gaussians.tensors())
        self._exp_avg = {name: torch.zeros_like(x.detach()) for name, x in gaussians.tensors().items()}
        self._exp_avg_sq = {name: torch.zeros_like(x.detach()) for name, x in gaussians.tensors().items()}

    def step(self, step: int, lr_means: float, *, dense: bool, frozen_rest: Tensor | None = None) -> int:
        """How many rows were left out for a gradient that is not finite; updates parameters and drops the gradients.

        Args:
            step: number of this step, from 1, for Adam's bias correction.
            lr_means: learning rate of the means, world units.
            frozen_rest: (N,) bool, Gaussians of whose harmonics only the base colour is updated; None: none.
            dense: update all Gaussians; otherwise, if ``optim.sparse``, only those that received a gradient: the others
                keep parameters and moments.
        """
        rows = None if dense or not self.options.sparse else self._rows_with_gradient()
        rates: dict[str, float | Tensor] = {
            "means": lr_means,
            "quats": self.options.lr_quats,
            "log_scales": self.options.lr_scales,
            "logit_opacities": self.options.lr_opacities,
            "sh": self._harmonics_rates(),
        }
        if frozen_rest is not None and self.parameters.sh.grad is not None:
            self.parameters.sh.grad[frozen_rest, 1:] = 0
        left_out = 0
        for name, x in self.parameters.tensors().items():
            if x.grad is not None:
                left_out += adam_step_(
                    x.detach(),
                    x.grad,
                    self._exp_avg[name],
                    self._exp_avg_sq[name],
                    lr=rates[name],
                    step=step,
                    eps=self.options.eps,
                    rows=rows,
                )
                x.grad = None
        return left_out

    def apply(self, result: EditResult) -> None:
        """Change the set of Gaussians: parameters and moments of survivors move along, new rows start without moments.

        All parameters become new leaf tensors; gradients are dropped.
        """
        moved: dict[str, Tensor] = {}
        for name, x in self.parameters.tensors().items():
            if result.edit is not None:
                self._exp_avg[name] = result.edit.apply_moments(self._exp_avg[name])
                self._exp_avg_sq[name] = result.edit.apply_moments(self._exp_avg_sq[name])
            if name in result.zero_moments:
                self._exp_avg[name].zero_()
                self._exp_avg_sq[name].zero_()
            if name in result.changes:
                moved[name] = result.changes[name]
            else:
                moved[name] = x if result.edit is None else result.edit.apply(x.detach())
        self.parameters = _as_leaves(moved)

    def drop_rest(self, base: Tensor, frozen_rest: Tensor) -> None:
        """Replace harmonics by a base colour, for good: rest and moments become zero; if they do for all, they go.

        Args:
            base: (N, 3) new constant coefficients.
            frozen_rest: (N,) bool, the Gaussians that have only that; the others stay as they are.
        """
        chosen = frozen_rest[:, None, None]
        sh = self.parameters.sh.detach()
        plain = torch.cat([base[:, None], torch.zeros_like(sh[:, 1:])], dim=1)
        count = 1 if bool(frozen_rest.all()) else sh.shape[1]
        self.parameters = _as_leaves({**self.parameters.tensors(), "sh": torch.where(chosen, plain, sh)[:, :count]})
        for moments in (self._exp_avg, self._exp_avg_sq):
            rest = torch.where(chosen, 0.0, moments["sh"][:, 1:])
            moments["sh"] = torch.cat([moments["sh"][:, :1], rest], dim=1)[:, :count].contiguous()

    def state(self) -> dict[str, Tensor]:
        """Parameters and moments by name, for a checkpoint: ``gaussians.*``, ``exp_avg.*``, ``exp_avg_sq.*``."""
        state = {f"gaussians.{name}": x.detach() for name, x in self.parameters.tensors().items()}
        state |= {f"exp_avg.{name}": x for name, x in self._exp_avg.items()}
        return state | {f"exp_avg_sq.{name}": x for name, x in self._exp_avg_sq.items()}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Take over what ``state()`` returned.

        Raises:
            KeyError: a tensor lacks.
            ValueError: one is not finite float32, or they do not fit together.
        """
        parts = {part: {n: state[f"{part}.{n}"].clone() for n in self.parameters.tensors()} for part in PARTS}
        parameters = Gaussians.stored(parts["gaussians"])
        for part in PARTS[1:]:
            for name, x in parameters.tensors().items():
                require_tensor(f"{part}.{name}", parts[part][name], tuple(x.shape))
        self.parameters = _as_leaves(parameters.tensors())
        self._exp_avg, self._exp_avg_sq = parts["exp_avg"], parts["exp_avg_sq"]

    def _harmonics_rates(self) -> Tensor:
        """(K * 3,) one rate per coefficient."""
        rates = torch.full((self.parameters.sh.shape[1], 3), self.options.lr_sh_rest)
        rates[0] = self.options.lr_sh_dc
        return rates.reshape(-1)

    def _rows_with_gradient(self) -> Tensor:
        """(N,) bool; opacity or position: a Gaussian at full opacity gets no gradient on its opacity alone."""
        opacity_grad, means_grad = self.parameters.logit_opacities.grad, self.parameters.means.grad
        if opacity_grad is None or means_grad is None:
            return torch.ones(len(self.parameters), dtype=torch.bool)
        return (opacity_grad != 0) | seen_rows(means_grad)


def _as_leaves(tensors: dict[str, Tensor]) -> Gaussians:
    return Gaussians(**{name: x.detach().contiguous().requires_grad_() for name, x in tensors.items()})
