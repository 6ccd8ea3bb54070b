"""The decoder MLP: named heads, zero at initialization."""

from __future__ import annotations

import math
from itertools import product

import pytest
import torch
from tiny_fields import HEADS

from dyngs.deform.field import Decoder, head_sizes, split_heads
from dyngs.deform.keys import FieldSection
from dyngs.gaussians.optimizer import Parameters

SIZES = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacities": 1, "colors": 3}


@pytest.mark.parametrize("chosen", list(product([False, True], repeat=len(HEADS))))
def test_heads_by_name(chosen: tuple[bool, ...]) -> None:
    """Outputs are consecutive columns in attribute order; disabled attributes have none."""
    moves = [name for name, is_on in zip(HEADS, chosen, strict=True) if is_on]
    options = FieldSection.model_validate({"moves": moves})
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


@pytest.mark.parametrize("skip", [None, 1])
def test_decoder_starts_at_zero_with_glorot_weights(skip: int | None) -> None:
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
