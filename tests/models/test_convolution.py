"""Parts of convolutional networks."""

from __future__ import annotations

import torch
from torch import nn

from dyngs.models.convolution import ResidualBlock, begin_weights, upsampled


def test_a_block_adds_to_what_comes_in() -> None:
    block = ResidualBlock(8)
    given = torch.randn(2, 8, 6, 5)
    assert block(given).shape == given.shape
    last = block.layers[-1]
    assert isinstance(last, nn.Conv2d)
    nn.init.zeros_(last.weight)
    assert last.bias is not None
    nn.init.zeros_(last.bias)
    assert torch.equal(block(given), given)


def test_upsampled_features_keep_their_place() -> None:
    ramp = torch.arange(6.0).expand(1, 1, 4, 6)
    fine = upsampled(ramp)
    assert fine.shape == (1, 1, 8, 12)
    torch.testing.assert_close(fine[0, 0, 0, 1:-1], (torch.arange(12.0) / 2 - 0.25)[1:-1])


def test_weights_follow_from_the_generator() -> None:
    networks = [
        nn.Sequential(nn.Conv2d(3, 8, 3), nn.GroupNorm(8, 8), nn.Conv2d(8, 4, 1, bias=False))
        for _ in range(2)
    ]
    for network in networks:
        begin_weights(network, torch.Generator().manual_seed(3))
    first, second = (network.state_dict() for network in networks)
    assert all(torch.equal(x, second[name]) for name, x in first.items())
    assert not first["0.bias"].any()
    assert 0.5 < first["0.weight"].std() / (2 / 27) ** 0.5 < 1.5
