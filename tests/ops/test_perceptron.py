"""The fused perceptron against torch in float64: determinism, and NaN confined to its row."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import dyngs.ops.perceptron as ops
from dyngs.ops.perceptron import (
    Layer,
    perceptron,
    reference_perceptron,
)


def make_layers(widths: list[int], skip: int | None, seed: int = 0) -> list[Layer]:
    """Float64 layers that keep the scale of their inputs, with gradients."""
    generator = torch.Generator().manual_seed(seed)
    layers = []
    for i, (before, out) in enumerate(pairwise(widths)):
        features = before + (widths[0] if i == skip else 0)
        weight = torch.randn(out, features, generator=generator, dtype=torch.float64) * math.sqrt(
            2 / features
        )
        bias = 0.1 * torch.randn(out, generator=generator, dtype=torch.float64)
        layers.append(Layer(weight.requires_grad_(), bias.requires_grad_()))
    return layers


def make_rows(rows: int, width: int, seed: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(rows, width, generator=generator, dtype=torch.float64).requires_grad_()


def cast(x: Tensor, layers: list[Layer], dtype: torch.dtype) -> tuple[Tensor, list[Layer]]:
    """The same numbers as new leaves."""

    def leaf(t: Tensor) -> Tensor:
        return t.detach().to(dtype).clone().requires_grad_()

    return leaf(x), [Layer(leaf(layer.weight), leaf(layer.bias)) for layer in layers]


def parameters(layers: list[Layer]) -> list[Tensor]:
    return [t for layer in layers for t in (layer.weight, layer.bias)]


def value_and_gradients(function, x: Tensor, layers: list[Layer], skip: int | None) -> list[Tensor]:
    """Output, then gradients by x and all parameters, for a fixed gradient of the output."""
    y = function(x, layers, skip=skip)
    generator = torch.Generator().manual_seed(2)
    grad = torch.randn(y.shape, generator=generator, dtype=torch.float64).to(y.dtype)
    return [y.detach(), *torch.autograd.grad(y, [x, *parameters(layers)], grad)]


def assert_close(got: list[Tensor], expected: list[Tensor], tolerance: float) -> None:
    """Assert closeness relative to the largest element, the scale of rounding in the sums."""
    for a, b in zip(got, expected, strict=True):
        assert a.shape == b.shape
        if b.numel():
            assert (a.double() - b).abs().max() <= tolerance * max(1.0, b.abs().max().item())


@st.composite
def networks(draw: st.DrawFn) -> tuple[list[int], int | None]:
    widths = draw(st.lists(st.integers(1, 70), min_size=2, max_size=5))
    layers = len(widths) - 1
    skip = draw(st.none() | st.integers(1, layers - 1)) if layers > 1 else None
    return widths, skip


@given(network=networks(), rows=st.integers(0, 200), kept=st.booleans(), seed=st.integers(0, 1000))
@settings(max_examples=60, deadline=None)
def test_double_equals_torch(
    network: tuple[list[int], int | None], rows: int, kept: bool, seed: int
) -> None:
    widths, skip = network
    x = make_rows(rows, widths[0], seed)
    layers = make_layers(widths, skip, seed)
    expected = value_and_gradients(reference_perceptron, x, layers, skip)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ops, "KEPT_BYTES", 2**30 if kept else -1)
        got = value_and_gradients(perceptron, x, layers, skip)
    assert_close(got, expected, 1e-12)


def test_a_row_does_not_depend_on_its_place() -> None:
    """Each row's output is bitwise equal alone and among other rows."""
    x, layers = cast(make_rows(230, 17), make_layers([17, 40, 9], None), torch.float32)
    together = perceptron(x, layers)
    for row in (0, 1, 95, 96, 97, 229):
        assert torch.equal(perceptron(x[row : row + 1], layers)[0], together[row])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("skip", [None, 2])
def test_nan_row_does_not_affect_others(value: float, skip: int | None) -> None:
    widths = [11, 20, 30, 5]
    x, layers = cast(make_rows(130, widths[0]), make_layers(widths, skip), torch.float32)
    good = perceptron(x, layers, skip=skip)
    spoilt = x.detach().clone()
    spoilt[77, 3] = value
    bad = perceptron(spoilt, layers, skip=skip)
    others = torch.arange(130) != 77
    assert torch.equal(bad[others], good[others])
    expected = reference_perceptron(spoilt[77:78], layers, skip=skip)[0]
    assert torch.equal(bad[77].isfinite(), expected.isfinite())
    assert bad[77].isnan().all() or not math.isnan(value)


def test_half_precision_is_computed_in_float() -> None:
    x, layers = cast(make_rows(9, 5), make_layers([5, 7, 3], None), torch.bfloat16)
    assert perceptron(x, layers).dtype == torch.float32
    grads = torch.autograd.grad(perceptron(x, layers).sum(), [x, *parameters(layers)])
    assert {g.dtype for g in grads} == {torch.bfloat16}


def bad_input(change: str) -> tuple[Tensor, list[Layer], int | None]:
    layers = make_layers([5, 7, 3], None)
    x = make_rows(9, 5)
    skip = None
    if change == "rows":
        x = x[0]
    elif change == "no columns":
        x = x[:, :0]
    elif change == "no layers":
        layers = []
    elif change == "weight":
        layers[1] = Layer(layers[1].weight[:, 1:], layers[1].bias)
    elif change == "bias":
        layers[0] = Layer(layers[0].weight, layers[0].bias[None])
    elif change == "integers":
        x = torch.ones(9, 5, dtype=torch.int64)
    elif change == "skip 0":
        skip = 0
    elif change == "skip too late":
        skip = 2
    elif change == "skip without room":
        skip = 1
    return x, layers, skip
