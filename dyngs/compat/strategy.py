"""Densification strategies with the interface of gsplat 1.5, for training loops of users.

Names and defaults follow gsplat's documentation; the edits are those of
``dyngs.gaussians.densify``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from dyngs import config
from dyngs.core.errors import DyngsError, log_info
from dyngs.gaussians import EditResult, Gaussians
from dyngs.gaussians.densify import (
    DENSE_FRACTION,
    DensifySchedule,
    McmcDensifier,
    apply_plan,
    plan_edit,
    with_opacity_reset,
)
from dyngs.ops.registration import LARGEST_COUNT

Params = nn.ParameterDict | dict[str, nn.Parameter]
Optimizers = Mapping[str, torch.optim.Optimizer]
State = dict[str, Any]

_FIELDS = {
    "means": "means",
    "quats": "quats",
    "scales": "log_scales",
    "opacities": "logit_opacities",
}
_MCMC_GROWTH = 0.05


@dataclass
class Strategy:
    """Interface of the strategies. Parameters are replaced in ``params`` and in the optimizers.

    ``params`` has means (N, 3), quats (N, 4), scales (N, 3) as logarithms, opacities (N,) or (N, 1)
    as logits, and any other values per Gaussian. Random numbers are those of ``torch.manual_seed``.
    """

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        """Raise DyngsError unless each trainable parameter has its own optimizer."""
        missing = ", ".join(_FIELDS.keys() - params.keys())
        if missing:
            raise DyngsError(f"params: {missing} missing; a strategy needs {', '.join(_FIELDS)}")
        for name, x in params.items():
            groups = optimizers[name].param_groups if name in optimizers else []
            optimised = [one for group in groups for one in group["params"]]
            if x.requires_grad and not (len(optimised) == 1 and optimised[0] is x):
                raise DyngsError(f"optimizers[{name!r}]: must optimise params[{name!r}] alone")

    def step_pre_backward(
        self,
        params: Params,
        optimizers: Optimizers,
        state: State,
        step: int,
        info: dict[str, Any],
    ) -> None:
        """Keep the gradient of the 2D means for ``step_post_backward``."""
        info["means2d"].retain_grad()


@dataclass
class DefaultStrategy(Strategy):
    """Clone, split and prune by the gradient of the 2D means (3DGS, AbsGS).

    Fields are those of gsplat; ``verbose`` logs edits to the logger ``dyngs``. Limits on the radius
    in the image and ``revised_opacity`` are not supported.
    """

    prune_opa: float = 0.005
    grow_grad2d: float = 0.0002
    grow_scale3d: float = 0.01
    grow_scale2d: float = 0.05
    prune_scale3d: float = 0.1
    prune_scale2d: float = 0.15
    refine_scale2d_stop_iter: int = 0
    refine_start_iter: int = 500
    refine_stop_iter: int = 15_000
    reset_every: int = 3000
    refine_every: int = 100
    pause_refine_after_reset: int = 0
    absgrad: bool = False
    revised_opacity: bool = False
    verbose: bool = False

    def __post_init__(self) -> None:
        if self.refine_scale2d_stop_iter > 0 or self.revised_opacity:
            raise DyngsError(
                "DefaultStrategy: refine_scale2d_stop_iter and revised_opacity are not supported; "
                "leave them out"
            )

    def initialize_state(self, scene_scale: float = 1.0) -> State:
        """Return the state of a training; ``scene_scale``: extent of the cameras, world units."""
        return {"grad2d": None, "count": None, "scene_scale": scene_scale}

    @torch.no_grad()
    def step_post_backward(
        self,
        params: Params,
        optimizers: Optimizers,
        state: State,
        step: int,
        info: dict[str, Any],
        packed: bool = False,
    ) -> None:
        """Accumulate gradients; densify, prune and reset opacities when they are due.

        ``packed`` is ignored: ``info`` shows whether it is packed.
        """
        if step >= self.refine_stop_iter:
            return
        self._accumulate_gradients(len(params["means"]), state, info)
        if (
            step > self.refine_start_iter
            and step % self.refine_every == 0
            and step % self.reset_every >= self.pause_refine_after_reset
        ):
            result = self._densify(_gaussians(params), state, step)
            _apply(result, params, optimizers, state)
            state["grad2d"] = None
            state["count"] = None
            if self.verbose:
                log_info(f"step {step}: {len(params['means']):,} Gaussians")
        if step > 0 and step % self.reset_every == 0:
            logits = _gaussians(params).logit_opacities
            reset = with_opacity_reset(EditResult(None), logits, 2 * self.prune_opa)
            _apply(reset, params, optimizers, state)

    def _accumulate_gradients(self, count: int, state: State, info: dict[str, Any]) -> None:
        means2d = info["means2d"]
        grad = means2d.absgrad if self.absgrad else means2d.grad
        size = grad.new_tensor([info["width"], info["height"]])
        lengths = (grad * (size / 2 * info["n_cameras"])).norm(dim=-1)
        rows = info["gaussian_ids"]
        if rows is None:
            visible = (info["radii"] > 0).all(-1)
            rows = torch.nonzero(visible)[:, 1]
            lengths = lengths[visible]
        if state["grad2d"] is None:
            state["grad2d"] = lengths.new_zeros(count)
            state["count"] = lengths.new_zeros(count)
        state["grad2d"].index_add_(0, rows, lengths)
        state["count"].index_add_(0, rows, torch.ones_like(lengths))

    def _densify(self, gaussians: Gaussians, state: State, step: int) -> EditResult:
        options = config.DefaultStrategy.model_construct(
            grad_threshold=self.grow_grad2d,
            prune_opacity=self.prune_opa,
            max_gaussians=LARGEST_COUNT,
        )
        extent = state["scene_scale"]
        max_scale = self.prune_scale3d * extent if step > self.reset_every else math.inf
        score = state["grad2d"] / state["count"].clamp_min(1)
        # ``plan_edit`` splits above the fixed fraction DENSE_FRACTION of its reference length.
        reference_length = self.grow_scale3d * extent / DENSE_FRACTION
        plan = plan_edit(gaussians, score, options, reference_length, max_scale)
        return apply_plan(gaussians, plan, torch.default_generator)


@dataclass
class MCMCStrategy(Strategy):
    """Relocate transparent Gaussians, grow up to ``cap_max``, add noise to positions (3DGS-MCMC).

    Fields are those of gsplat; ``verbose`` logs edits to the logger ``dyngs``.
    """

    cap_max: int = 1_000_000
    noise_lr: float = 5e5
    refine_start_iter: int = 500
    refine_stop_iter: int = 25_000
    refine_every: int = 100
    min_opacity: float = 0.005
    verbose: bool = False

    def initialize_state(self) -> State:
        """Return the state of a training, which is empty."""
        return {}

    @torch.no_grad()
    def step_post_backward(
        self,
        params: Params,
        optimizers: Optimizers,
        state: State,
        step: int,
        info: dict[str, Any],
        lr: float,
    ) -> None:
        """Relocate and add Gaussians when due, then add noise; ``lr``: learning rate of means."""
        options = config.McmcStrategy.model_construct(
            max_gaussians=self.cap_max, prune_opacity=self.min_opacity, noise=self.noise_lr
        )
        schedule = DensifySchedule(self.refine_start_iter, self.refine_stop_iter, self.refine_every)
        densifier = McmcDensifier(options, schedule, _MCMC_GROWTH)
        result = densifier.edit(step, _gaussians(params), torch.default_generator)
        if result is not None:
            _apply(result, params, optimizers, state)
            if self.verbose:
                log_info(f"step {step}: {len(params['means']):,} Gaussians")
        densifier.perturb(_gaussians(params), lr, torch.default_generator)


def _gaussians(params: Params) -> Gaussians:
    """Return the parameters as Gaussians that share their memory, with a placeholder as colour."""
    fields = {field: params[name].detach() for name, field in _FIELDS.items()}
    fields["logit_opacities"] = fields["logit_opacities"].reshape(-1)
    return Gaussians(**fields, sh=fields["means"][:, None])


def _apply(result: EditResult, params: Params, optimizers: Optimizers, state: State) -> None:
    """Replace the parameters, their moments, and the tensors (N, ...) of ``state``."""
    edit = result.edit
    count = len(params["means"])
    for name, old in list(params.items()):
        field = _FIELDS.get(name, name)
        values = result.changes.get(field)
        if values is None:
            if edit is None:
                continue
            values = edit.apply(old.detach())
        new = nn.Parameter(values.reshape(-1, *old.shape[1:]), requires_grad=old.requires_grad)
        params[name] = new
        if name not in optimizers:
            continue
        optimizer = optimizers[name]
        moments = optimizer.state.pop(old, {})
        for key, x in moments.items():
            if isinstance(x, Tensor) and x.shape == old.shape:
                moved = x if edit is None else edit.apply_moments(x)
                moments[key] = torch.zeros_like(moved) if field in result.zero_moments else moved
        optimizer.state[new] = moments
        optimizer.param_groups[0]["params"] = [new]
    for key, x in state.items():
        if edit is not None and isinstance(x, Tensor) and x.shape[:1] == (count,):
            state[key] = edit.apply(x)
