"""The MLP field: positional encoding, skip connection and inputs."""

from __future__ import annotations

import math

import pytest
import torch
from tiny_fields import cloud, stir, tiny_setup

from dyngs.deform.field import Offsets
from dyngs.deform.keys import MlpField
from dyngs.deform.networks import SKIP_LAYER, Mlp, encode_frequencies


def outputs(offsets: Offsets) -> list[torch.Tensor]:
    return [x.detach() for x in vars(offsets).values() if x is not None]


def test_the_encoding_has_known_values() -> None:
    x = torch.tensor([[0.0, 0.5], [math.pi / 2, -1.0]], dtype=torch.float64)
    found = encode_frequencies(x, 2)
    assert found.shape == (2, 10)
    columns = [x[:, :1], x[:, 1:]]
    expected = [x, *(f(k * c) for f in (torch.sin, torch.cos) for k in (1, 2) for c in columns)]
    torch.testing.assert_close(found, torch.cat(expected, dim=1))
    assert torch.equal(encode_frequencies(x, 0), x)


@pytest.mark.parametrize(
    ("depth", "skips"), [(2, False), (SKIP_LAYER, False), (SKIP_LAYER + 1, True), (8, True)]
)
def test_deep_networks_see_the_input_once_more(depth: int, skips: bool) -> None:
    field = Mlp(MlpField(depth=depth, width=6), tiny_setup(), torch.Generator())
    num_inputs = 3 * (1 + 2 * 10) + 1 + 2 * 6
    widths = [field.parameters[f"weight{i}"].shape[1] for i in range(depth + 1)]
    expected = [num_inputs] + [6] * depth
    if skips:
        expected[SKIP_LAYER] += num_inputs
    assert widths == expected
    assert not any(x.any() for x in outputs(field.offsets(cloud().means, 0.3)))


def test_time_may_be_encoded_by_a_network() -> None:
    options = MlpField(depth=2, width=6, time_features=4, time_frequencies=10)
    field = Mlp(options, tiny_setup(), torch.Generator().manual_seed(0))
    assert field.parameters["time_weight0"].shape == (6, 1 + 2 * 10)
    assert field.parameters["weight0"].shape == (6, 3 * (1 + 2 * 10) + 4)
    means = cloud().means
    assert not any(x.any() for x in outputs(field.offsets(means, 0.3)))
    stir(field)
    one, other = (field.offsets(means, time).means for time in (0.3, 0.8))
    assert not torch.allclose(one, other)
    one.sum().backward()
    assert field.parameters["time_weight0"].grad is not None
