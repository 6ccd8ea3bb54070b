"""Adam in place on arrays of rows, for all rows or only some: in float32 on the CPU one native pass over the memory."""

from __future__ import annotations

import math
from typing import TypeAlias

import torch
from torch import Tensor

from dyngs.errors import DyngsError
from dyngs.ops.device import sent
from dyngs.ops.native import num_threads
from dyngs.ops.registration import InPlace, has_kernel, launch, register

Count: TypeAlias = int | Tensor  # a number, or a tensor () of one that may still be on a GPU, where int waits for it


def _adam_step(
    param: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    rates: Tensor,
    rows: Tensor | None,
    betas: list[float],
    eps: float,
    step: int,
) -> Tensor:
    skipped = param.new_zeros(1, dtype=torch.int32)
    changed, options = [InPlace(x) for x in (param, exp_avg, exp_avg_sq)], (betas[0], betas[1], eps, step)
    launch(param, "adam_step", changed[0], grad, *changed[1:], rates, rows, skipped, options, num_threads())
    return skipped[0].long()


adam_step_op = register("adam_step_", _adam_step, mutates=("param", "exp_avg", "exp_avg_sq"))
"""Update (N, C) arrays in place, with rates (C,) and rows (N,) bool; returns the number () int64 of rows skipped."""


def _seen_rows(grads: Tensor) -> Tensor:
    seen = grads.new_empty(grads.shape[0], dtype=torch.bool)
    launch(grads, "seen_rows", grads, seen, num_threads())
    return seen


seen_rows_op = register("seen_rows", _seen_rows)


@torch.no_grad()
def adam_step_(
    param: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    *,
    lr: float | Tensor,
    step: int,
    eps: float = 1e-15,
    betas: tuple[float, float] = (0.9, 0.999),
    rows: Tensor | None = None,
) -> Tensor:
    """Update ``param`` and its two moments in place; return the number () int64 of rows skipped for a bad gradient.

    Kingma and Ba 2015, equal to ``torch.optim.Adam``; the bias correction follows the global ``step`` (from 1) also for
    rows skipped before. A gradient is bad if it is NaN, infinite, or so large that its square is not safely finite
    (2^63 in float32, 2^511 in float64). ``param`` (N, ...) contiguous: N rows of C numbers; ``grad`` and the moments
    have its shape, the moments contiguous; ``lr``: a rate, or (C,) rates, better on the CPU; ``rows`` (N,) bool: the
    rows to update, None: all. Raises DyngsError: shapes or dtypes that do not fit, or constants out of range.
    """
    _check(param, grad, exp_avg, exp_avg_sq, rows, step)
    if not torch.finfo(param.dtype).tiny <= eps < math.inf:
        raise DyngsError(f"Adam: eps must be at least {torch.finfo(param.dtype).tiny:.3g} and finite, got {eps}")
    if not all(0 <= beta < 1 for beta in betas):
        raise DyngsError(f"Adam: betas must lie in [0, 1), got {betas[0]} and {betas[1]}")
    if param.numel() == 0:
        return torch.zeros((), dtype=torch.int64, device=param.device)
    row_size = param.numel() // len(param)
    rates = _column_rates(lr, row_size, param)
    p, g, m, v = (x.detach().view(len(param), row_size) for x in (param, grad.contiguous(), exp_avg, exp_avg_sq))
    native = param.dtype == torch.float32 and has_kernel("adam_step_", param.device)
    return (adam_step_op if native else _torch_adam_step)(p, g, m, v, rates, rows, list(betas), eps, step)


@torch.no_grad()
def seen_rows(grads: Tensor) -> Tensor:
    """Return (N,) bool: the rows of ``grads`` (N, ...) with an element other than zero; NaN counts as one."""
    if grads.numel() == 0:
        return torch.zeros(len(grads), dtype=torch.bool, device=grads.device)
    flat = grads.detach().reshape(len(grads), -1)
    native = flat.dtype == torch.float32 and has_kernel("seen_rows", flat.device)
    return seen_rows_op(flat) if native else (flat != 0).any(dim=1)


def _torch_adam_step(
    param: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    rates: Tensor,
    rows: Tensor | None,
    betas: list[float],
    eps: float,
    step: int,
) -> Tensor:
    """Return the number of rows skipped, as ``adam_step_op``, in plain torch: for other dtypes and devices."""
    too_large = 2.0 ** (math.frexp(torch.finfo(grad.dtype).max)[1] // 2 - 1)
    usable = (grad.abs() < too_large).all(dim=1)  # NaN is not
    wanted = torch.ones_like(usable) if rows is None else rows
    active = (wanted & usable)[:, None]
    new_avg = exp_avg.lerp(grad, 1 - betas[0])
    new_avg_sq = (exp_avg_sq * betas[1]).addcmul(grad, grad, value=1 - betas[1])
    denominator = (new_avg_sq.sqrt() / (1 - betas[1] ** step) ** 0.5).add(eps)
    new_param = param - rates / (1 - betas[0] ** step) * new_avg / denominator
    for old, new in ((param, new_param), (exp_avg, new_avg), (exp_avg_sq, new_avg_sq)):
        old.copy_(torch.where(active, new, old))
    return (wanted & ~usable).sum()


def _column_rates(lr: float | Tensor, row_size: int, param: Tensor) -> Tensor:
    """(C,) learning rates in the dtype and on the device of ``param``."""
    is_finite = bool(lr.isfinite().all()) if isinstance(lr, Tensor) else math.isfinite(lr)
    if not is_finite:
        raise DyngsError("Adam: lr must be finite")
    if not isinstance(lr, Tensor):
        return torch.full((row_size,), lr, dtype=param.dtype, device=param.device)
    rates = sent(lr.detach(), param.device).to(param.dtype)
    if rates.ndim == 0:
        return rates.expand(row_size).contiguous()
    if rates.shape != (row_size,):
        raise DyngsError(f"Adam: lr must be a number or ({row_size},), one rate per column, got {tuple(rates.shape)}")
    return rates.contiguous()


def _check(param: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, rows: Tensor | None, step: int) -> None:
    if param.ndim == 0:
        raise DyngsError("Adam: the parameter must have at least one dimension, got a scalar")
    for name, x in (("grad", grad), ("exp_avg", exp_avg), ("exp_avg_sq", exp_avg_sq)):
        if x.shape != param.shape or x.dtype != param.dtype:
            raise DyngsError(
                f"Adam: {name} is {tuple(x.shape)} {x.dtype}, but the parameter {tuple(param.shape)} {param.dtype}"
            )
    for name, x in (("param", param), ("exp_avg", exp_avg), ("exp_avg_sq", exp_avg_sq)):
        if not x.is_contiguous():
            raise DyngsError(f"Adam: {name} must be contiguous, as it is updated in place; call .contiguous() first")
    if rows is not None and (rows.shape != param.shape[:1] or rows.dtype != torch.bool):
        raise DyngsError(f"Adam: rows must be ({len(param)},) bool, got {tuple(rows.shape)} {rows.dtype}")
    if step < 1:
        raise DyngsError(f"Adam: step counts from 1, got {step}")
