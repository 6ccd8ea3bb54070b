"""From options to fields, and through a checkpoint back."""

from __future__ import annotations

import pytest
import torch
from tiny_fields import (
    ALL_KINDS,
    KINDS,
    TIMES,
    cloud,
    stirred_field,
    tiny_field,
    tiny_options,
    tiny_setup,
)

from dyngs.core.state import tensors_of
from dyngs.deform.control_nodes import ControlNodes
from dyngs.deform.fields import field_state, new_field, restored_field
from dyngs.deform.free import FreePrimitives
from dyngs.deform.hexplane import Hexplane
from dyngs.deform.mlp import Mlp


def test_options_decide_the_kind() -> None:
    kinds = {
        "hexplane": Hexplane,
        "mlp": Mlp,
        "control_nodes": ControlNodes,
        "free": FreePrimitives,
    }
    for kind, expected in kinds.items():
        assert type(tiny_field(kind)) is expected


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_a_restored_field_moves_everything_alike(kind: str) -> None:
    """Bitwise, also in the next steps of training; the setup comes back, too."""
    field = stirred_field(kind)
    setup = tiny_setup()
    means = cloud().means
    for time in TIMES:
        field.offsets(means, time).means.square().sum().backward()
    field.parameters.step(1, 0.0)
    state = {name: x.clone() for name, x in tensors_of(field_state(field)).items()}
    again = restored_field(tiny_options(kind), state, 9)
    same = again.setup
    assert torch.equal(same.center, setup.center)
    assert torch.equal(same.half_size, setup.half_size)
    assert (same.num_times, same.num_moving, same.extent) == (setup.num_times, 9, setup.extent)
    for step in (2, 3):
        for one in (field, again):
            one.offsets(means, 0.2 * step).means.square().sum().backward()
            one.parameters.step(step, 0.5)
    for time in TIMES:
        found = again.offsets(means, time)
        expected = field.offsets(means, time)
        for name, x in vars(expected).items():
            assert (x is None) == (getattr(found, name) is None)
            assert x is None or torch.equal(getattr(found, name), x), name


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_what_is_missing_is_named(kind: str) -> None:
    state = tensors_of(field_state(tiny_field(kind)))
    for name in ("box", "numbers", next(name for name in state if name.startswith("learned."))):
        with pytest.raises(KeyError, match=name.removeprefix("learned.")):
            restored_field(tiny_options(kind), {k: x for k, x in state.items() if k != name}, 9)


def test_the_generator_decides_everything() -> None:
    for kind in ALL_KINDS:
        fields = [
            new_field(tiny_options(kind), tiny_setup(), torch.Generator().manual_seed(s))
            for s in (1, 1, 2)
        ]
        first, second, other = (f.parameters.values() for f in fields)
        assert all(torch.equal(x, second[name]) for name, x in first.items())
        assert kind == "control_nodes" or any(
            not torch.equal(x, other[name]) for name, x in first.items()
        )


@pytest.mark.parametrize("kind", KINDS)
def test_some_rows_are_moved_as_among_all(kind: str) -> None:
    """1e-6 for sums of other lengths; gradients reach only their canonical means."""
    field = stirred_field(kind)
    means = cloud().means.requires_grad_()
    rows = torch.tensor([7, 2, 3])
    everything = field.offsets(means, 0.37)
    some = field.offsets(means, 0.37, rows)
    for name, x in vars(everything).items():
        assert x is not None
        torch.testing.assert_close(getattr(some, name), x[rows], rtol=0, atol=1e-6)
    if kind == "control_nodes":
        (slope,) = torch.autograd.grad(some.means.sum(), means)
        assert set(torch.nonzero(slope.any(1))[:, 0].tolist()) == {2, 3, 7}
    assert len(field.offsets(means, 0.37, rows[:0]).means) == 0
