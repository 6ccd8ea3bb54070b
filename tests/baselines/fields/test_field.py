"""Pieces of networks."""

from __future__ import annotations

import torch

from dyngs.baselines.fields.field import network, truncated_exp


def test_the_gradient_of_the_exponential_stops_growing() -> None:
    x = torch.tensor([-2.0, 0.0, 14.0, 20.0], dtype=torch.float64, requires_grad=True)
    value = truncated_exp(x)
    assert torch.equal(value, x.exp())
    (grad,) = torch.autograd.grad(value.sum(), x)
    assert torch.equal(grad, x.detach().clamp(max=15).exp())


def test_a_network_has_no_biases() -> None:
    weights = [torch.randn(5, 3, generator=torch.Generator().manual_seed(i)) for i in range(1)]
    x = torch.randn(4, 3, generator=torch.Generator().manual_seed(9))
    assert torch.allclose(network(x, weights), x @ weights[0].T, atol=1e-6)
    assert not network(torch.zeros(2, 3), weights).any()
