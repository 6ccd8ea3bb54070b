"""Fused Adam step compared with torch.optim.Adam, and skipped rows."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from dyngs.ops.adam import (
    adam_step_,
    seen_rows,
)

# Rows shorter and longer than a vector, tails, several blocks of 2048 floats, and one row longer
# than a block.
SHAPES = [(1,), (700,), (5000,), (701, 3), (1, 4), (90, 15, 3), (130, 16, 3), (3, 2500)]


def make_state(
    shape: tuple[int, ...], dtype: torch.dtype = torch.float32, seed: int = 0
) -> tuple[Tensor, ...]:
    """A parameter, its gradient, and moments as in the middle of training."""
    generator = torch.Generator().manual_seed(seed)
    param, grad, exp_avg, exp_avg_sq = (
        torch.randn(shape, generator=generator, dtype=dtype) for _ in range(4)
    )
    return param, grad, exp_avg, exp_avg_sq.abs()


def assert_within(actual: Tensor, expected: Tensor, allowed: Tensor) -> None:
    """Assert that no element differs by more than ``allowed``, a bound on rounding per element."""
    excess = (actual.double() - expected.double()).abs() - allowed
    assert excess.numel() == 0 or excess.max() <= 0, (
        f"{excess.max():.3g} more than rounding explains"
    )


def train(param: Tensor, lr: float | Tensor, steps: int, eps: float) -> Tensor:
    """The parameter after some steps with gradients of very different magnitude."""
    generator = torch.Generator().manual_seed(1)
    param = param.clone()
    moments = torch.zeros_like(param), torch.zeros_like(param)
    for step in range(1, steps + 1):
        grad = 10.0 ** (-step % 7) * torch.randn(
            param.shape, generator=generator, dtype=param.dtype
        )
        assert adam_step_(param, grad, *moments, lr=lr, step=step, eps=eps) == 0
    return param


def train_with_torch(param: Tensor, lr: float, steps: int, eps: float) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    param = param.clone()
    optimizer = torch.optim.Adam([param], lr=lr, eps=eps, foreach=False)
    for step in range(1, steps + 1):
        param.grad = 10.0 ** (-step % 7) * torch.randn(
            param.shape, generator=generator, dtype=param.dtype
        )
        optimizer.step()
    return param


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equals_torch_over_50_steps(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    param = make_state(shape, dtype)[0]
    expected = train_with_torch(param, 0.01, 50, 1e-15)
    moved = train(param, 0.01, 50, 1e-15)
    # Each of 50 steps rounds the value in both, and a step of at most 0.01 (1 - beta1) / sqrt(1 -
    # beta2) = 0.032 twelve times in each (see below).
    unit = torch.finfo(dtype).eps
    assert_within(moved, expected, 50 * unit * (param.double().abs() + 0.5 + 12 * 0.032))


@pytest.mark.parametrize("shape", [(50,), (701, 3), (130, 16, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_rows_with_non_finite_gradient_are_left_out_and_counted(
    shape: tuple[int, ...], dtype: torch.dtype, bad: float
) -> None:
    param, grad, exp_avg, exp_avg_sq = make_state(shape, dtype)
    rows = torch.ones(shape[0], dtype=torch.bool)
    rows[7] = False
    grad.view(shape[0], -1)[[3, 7, 20], -1] = bad
    state = [param.clone(), exp_avg.clone(), exp_avg_sq.clone()]
    assert adam_step_(state[0], grad, *state[1:], lr=0.1, step=5) == 3
    for before, after in zip((param, exp_avg, exp_avg_sq), state, strict=True):
        assert after.isfinite().all()
        assert torch.equal(after[[3, 7, 20]], before[[3, 7, 20]])
        assert not torch.equal(after[4], before[4])
    assert (
        adam_step_(
            *(x.clone() for x in (param, grad, exp_avg, exp_avg_sq)), lr=0.1, step=5, rows=rows
        )
        == 2
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_only_seen_rows_are_updated(dtype: torch.dtype) -> None:
    grads = torch.zeros(2000, 4, 3, dtype=dtype)
    grads[5, 3, 2] = 1e-40
    grads[700, 0, 0] = -1
    grads[1999, 1, 1] = math.nan
    grads[9, 0, 0] = -0.0
    assert seen_rows(grads).nonzero().flatten().tolist() == [5, 700, 1999]
    assert seen_rows(grads[:, 3, 2]).nonzero().flatten().tolist() == [5]


def test_the_parameter_counts_as_changed_for_autograd() -> None:
    param, grad, exp_avg, exp_avg_sq = make_state((6, 3))
    param.requires_grad_()
    square = param.square().sum()
    adam_step_(param, grad, exp_avg, exp_avg_sq, lr=0.1, step=1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        square.backward()
