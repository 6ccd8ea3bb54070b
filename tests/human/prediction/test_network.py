"""The UNet: shapes, zeros before training, weights from the generator."""

from __future__ import annotations

import pytest
import torch

from dyngs.errors import DyngsError
from dyngs.human.prediction.network import HEADS, AtlasNetwork


def network(seed: int = 0, widths: tuple[int, ...] = (8, 16)) -> AtlasNetwork:
    return AtlasNetwork(6, 3, widths, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("widths", [(8,), (8, 16), (8, 16, 24)])
def test_predictions_are_zero_before_training(widths: tuple[int, ...]) -> None:
    found = network(0, widths)(torch.rand(6, 32, 32))
    assert found.shape == (3, sum(HEADS.values()), 32, 32)
    assert (found == 0).all()


def test_weights_come_from_the_generator_alone() -> None:
    torch.manual_seed(1)
    first = network().state_dict()
    torch.manual_seed(2)
    again, other = network().state_dict(), network(1).state_dict()
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["last.0.weight"], other["last.0.weight"])


def test_every_weight_matters_once_the_heads_do() -> None:
    made, generator = network(), torch.Generator().manual_seed(3)
    torch.nn.init.normal_(made.heads.weight, generator=generator)
    made(torch.rand(6, 32, 32, generator=generator)).square().sum().backward()
    for name, parameter in made.named_parameters():
        assert parameter.grad is not None, name
        assert bool((parameter.grad != 0).any()), name


def test_what_is_far_away_in_the_atlas_is_seen() -> None:
    """A texel's input changes predictions at the other side: unseen parts are painted by what is seen elsewhere."""
    made, generator = network(0, (8, 8, 8, 8)), torch.Generator().manual_seed(3)
    torch.nn.init.normal_(made.heads.weight, generator=generator)
    maps = torch.rand(6, 32, 32, generator=generator)
    other = maps.clone()
    other[:, :4, :4] = 0
    assert bool((made(maps)[..., 28:, 28:] != made(other)[..., 28:, 28:]).any())


def test_odd_widths_are_refused() -> None:
    with pytest.raises(DyngsError, match="multiples of 8"):
        network(0, (8, 12))
