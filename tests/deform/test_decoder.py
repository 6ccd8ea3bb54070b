"""The decoder is a plain perceptron, its heads have names, and it starts at zero."""

from __future__ import annotations

import math
from itertools import product

import pytest
import torch
from tiny_fields import HEADS

from dyngs.deform.decoder import Decoder, head_sizes, split_heads
from dyngs.deform.keys import FieldSection
from dyngs.gaussians.parameters import Parameters

SIZES = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacities": 1, "colors": 3}


def decoder_with(hidden: list[int], *, skip: int | None = None) -> tuple[Decoder, Parameters]:
    """A decoder of 5 features with random weights in all layers."""
    decoder = Decoder(5, hidden, FieldSection(), skip=skip)
    generator = torch.Generator().manual_seed(1)
    values = decoder.start_values(generator)
    values = {name: torch.randn(x.shape, generator=generator) for name, x in values.items()}
    return decoder, Parameters(values, dict.fromkeys(values, 1.0))


@pytest.mark.parametrize("chosen", list(product([False, True], repeat=len(HEADS))))
def test_heads_by_name(chosen: tuple[bool, ...]) -> None:
    """Outputs are consecutive columns in the order of the attributes; what is off has none."""
    options = FieldSection(**dict(zip(HEADS, chosen, strict=True)))
    is_on = dict(zip(SIZES, (True, *chosen), strict=True))
    sizes = {name: size for name, size in SIZES.items() if is_on[name]}
    assert dict(head_sizes(options)) == sizes
    outputs = torch.arange(2.0 * sum(sizes.values())).reshape(2, -1)
    found = vars(split_heads(outputs, options))
    column = 0
    for name, size in SIZES.items():
        if not is_on[name]:
            assert found[name] is None
            continue
        expected = outputs[:, column : column + size]
        assert torch.equal(found[name], expected[:, 0] if name == "logit_opacities" else expected)
        column += size


@pytest.mark.parametrize(
    ("hidden", "skip"), [([7], None), ([6, 4, 9], None), ([6, 4, 9], 2), ([4, 4], 1)]
)
def test_it_is_a_plain_perceptron(hidden: list[int], skip: int | None) -> None:
    decoder, learned = decoder_with(hidden, skip=skip)
    features = torch.randn((11, 5), generator=torch.Generator().manual_seed(2))
    x = features.double()
    for i in range(len(hidden) + 1):
        x = torch.cat([x, features.double()], dim=1) if i == skip else x
        x = x @ learned[f"weight{i}"].double().T + learned[f"bias{i}"].double()
        x = x.clamp_min(0) if i < len(hidden) else x
    torch.testing.assert_close(decoder(features, learned).double(), x, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("skip", [None, 1])
def test_it_starts_at_zero_with_weights_of_glorot(skip: int | None) -> None:
    decoder = Decoder(20, [60, 50], FieldSection(), skip=skip)
    values = decoder.start_values(torch.Generator().manual_seed(0))
    assert not values["weight2"].any()
    assert not any(values[f"bias{i}"].any() for i in range(3))
    for i, fan_in in ((0, 20), (1, 60 + (20 if skip else 0))):
        weight = values[f"weight{i}"]
        assert weight.shape[1] == fan_in
        bound = math.sqrt(6 / sum(weight.shape))
        assert 0.9 * bound < weight.abs().max() <= bound
        # of some thousand numbers
        assert float(weight.var()) == pytest.approx(bound**2 / 3, rel=0.15)
    learned = Parameters(values, dict.fromkeys(values, 1.0))
    assert not decoder(torch.randn(4, 20), learned).any()


def test_the_generator_decides_the_weights() -> None:
    decoder = Decoder(3, [4], FieldSection())
    first, second, other = (
        decoder.start_values(torch.Generator().manual_seed(seed)) for seed in (5, 5, 6)
    )
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert not torch.equal(first["weight0"], other["weight0"])
