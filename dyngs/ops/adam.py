"""Adam in place on rows of arrays; one fused native pass in float32."""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
# The stubs of torch leave parts of these functions untyped.

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeAlias, cast

import torch
from torch import Tensor

from dyngs.ops.device import copy_async
from dyngs.ops.registration import InPlace, has_kernel, launch, register

# A number, or a tensor () that may still be computed on a GPU; int() waits for it.
Count: TypeAlias = int | Tensor


def _adam_steps(
    params: list[Tensor],
    grads: list[Tensor],
    exp_avgs: list[Tensor],
    exp_avg_sqs: list[Tensor],
    rates: list[Tensor],
    rows: list[Tensor | None],
    betas: list[float],
    eps: float,
    step: int,
) -> Tensor:
    skipped = params[0].new_zeros(1, dtype=torch.int32)
    arrays = [
        (InPlace(param), grad, InPlace(first), InPlace(second), rate, chosen)
        for param, grad, first, second, rate, chosen in zip(
            params, grads, exp_avgs, exp_avg_sqs, rates, rows, strict=True
        )
    ]
    launch(params[0], "adam_steps", arrays, skipped, (*betas, eps, step))
    return skipped[0].long()


adam_steps_op = register("adam_steps_", _adam_steps, mutates=("params", "exp_avgs", "exp_avg_sqs"))
"""Update arrays in place with learning rates (C,) and row masks (size / C,); return the skipped
rows."""


def _seen_rows(grads: Tensor) -> Tensor:
    seen = grads.new_empty(grads.shape[0], dtype=torch.bool)
    launch(grads, "seen_rows", grads, seen)
    return seen


seen_rows_op = register("seen_rows", _seen_rows)


@dataclass(frozen=True)
class AdamUpdate:
    """An Adam update of ``param`` (N, ...): N rows of C numbers.

    ``grad`` and the moments have the same shape. ``lr``: one rate, or (C,) rates, preferably on
    the CPU. ``rows`` (N,) bool: rows to update, None: all. All but ``grad`` are contiguous.
    """

    param: Tensor
    grad: Tensor
    exp_avg: Tensor
    exp_avg_sq: Tensor
    lr: float | Tensor
    rows: Tensor | None = None


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
    """Apply ``adam_steps_`` to one array."""
    return adam_steps_(
        [AdamUpdate(param, grad, exp_avg, exp_avg_sq, lr, rows)], step=step, eps=eps, betas=betas
    )


@torch.no_grad()
def adam_steps_(
    updates: Sequence[AdamUpdate],
    *,
    step: int,
    eps: float = 1e-15,
    betas: tuple[float, float] = (0.9, 0.999),
) -> Tensor:
    """Update arrays of one dtype and device in place; return the number () of skipped rows.

    Equal to ``torch.optim.Adam`` (Kingma and Ba 2015). Bias correction uses the global ``step``,
    from 1, also for rows skipped before. Rows are skipped if their gradient is NaN, infinite, or
    its square would not be finite (2^63 in float32, 2^511 in float64). At least one update is
    required.
    """
    like = updates[0].param
    wanted = [x for x in updates if x.param.numel()]
    if not wanted:
        return torch.zeros((), dtype=torch.int64, device=like.device)
    names = "param", "grad", "exp_avg", "exp_avg_sq"
    arrays = [[getattr(x, name).detach() for x in wanted] for name in names]
    rates = [_column_rates(x.lr, x.param) for x in wanted]
    rows = [x.rows for x in wanted]
    if like.dtype == torch.float32 and has_kernel(like.device):
        return cast(Any, adam_steps_op)(*arrays, rates, rows, list(betas), eps, step)
    each: list[Any] = list(zip(*arrays, rates, rows, strict=True))
    update: Any = _torch_adam_step
    return torch.stack([update(*one, betas, eps, step) for one in each]).sum()


@torch.no_grad()
def seen_rows(grads: Tensor) -> Tensor:
    """Return (N,) bool: rows of ``grads`` (N, ...) with a non-zero or NaN element."""
    if grads.numel() == 0:
        return torch.zeros(len(grads), dtype=torch.bool, device=grads.device)
    flat = grads.detach().reshape(len(grads), -1)
    native = flat.dtype == torch.float32 and has_kernel(flat.device)
    return seen_rows_op(flat) if native else (flat != 0).any(dim=1)


def _torch_adam_step(
    param: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    rates: Tensor,
    rows: Tensor | None,
    betas: tuple[float, float],
    eps: float,
    step: int,
) -> Tensor:
    """Plain torch version of ``adam_steps_op``, for other dtypes and devices; return the skipped
    rows."""
    param, grad, exp_avg, exp_avg_sq = (
        x.reshape(len(x), -1) for x in (param, grad, exp_avg, exp_avg_sq)
    )
    too_large = 2.0 ** (math.frexp(torch.finfo(grad.dtype).max)[1] // 2 - 1)
    usable = (grad.abs() < too_large).all(dim=1)  # False for NaN
    wanted = torch.ones_like(usable) if rows is None else rows
    active = (wanted & usable)[:, None]
    new_avg = exp_avg.lerp(grad, 1 - betas[0])
    new_avg_sq = (exp_avg_sq * betas[1]).addcmul(grad, grad, value=1 - betas[1])
    denominator = (new_avg_sq.sqrt() / (1 - betas[1] ** step) ** 0.5).add(eps)
    new_param = param - rates / (1 - betas[0] ** step) * new_avg / denominator
    for old, new in ((param, new_param), (exp_avg, new_avg), (exp_avg_sq, new_avg_sq)):
        old.copy_(torch.where(active, new, old))
    return (wanted & ~usable).sum()


def _column_rates(lr: float | Tensor, param: Tensor) -> Tensor:
    """Return learning rates (C,) in the dtype and on the device of ``param``."""
    values = tuple(lr.detach().reshape(-1).tolist()) if isinstance(lr, Tensor) else (lr,)
    return _rates(values, param.numel() // len(param), param.dtype, param.device)


@lru_cache(maxsize=256)  # most rates repeat from the previous step and are already on the GPU
def _rates(
    values: tuple[float, ...], row_size: int, dtype: torch.dtype, device: torch.device
) -> Tensor:
    rates = copy_async(torch.tensor(values, dtype=dtype, device="cpu"), device)
    return rates.expand(row_size).contiguous()
