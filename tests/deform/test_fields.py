"""Construction of fields from options, and their checkpoints."""

from __future__ import annotations

import pytest
import torch
from tiny_fields import (
    ALL_KINDS,
    TIMES,
    cloud,
    moved,
    stirred_field,
    tiny_field,
    tiny_options,
    tiny_setup,
)
from torch import Tensor

from dyngs.core.state import strip_roles
from dyngs.deform.fields import field_state, restore_field
from dyngs.gaussians import Gaussians


def total(gaussians: Gaussians) -> Tensor:
    """A number that depends on every value."""
    return torch.stack([x.square().sum() for x in gaussians.tensors().values()]).sum()


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_restored_field_moves_gaussians_equally(kind: str) -> None:
    """Bitwise, also in later training steps; the setup is restored, too."""
    field = stirred_field(kind)
    setup = tiny_setup()
    gaussians = cloud()
    for time in TIMES:
        total(moved(field, gaussians, time)).backward()
    field.parameters.step(1, 0.0)
    state = {name: x.clone() for name, x in strip_roles(field_state(field)).items()}
    again = restore_field(tiny_options(kind), state, 9, 4)
    same = again.setup
    assert torch.equal(same.center, setup.center)
    assert torch.equal(same.half_size, setup.half_size)
    assert (same.num_times, same.num_moving, same.extent) == (setup.num_times, 9, setup.extent)
    for step in (2, 3):
        for one in (field, again):
            total(moved(one, gaussians, 0.2 * step)).backward()
            one.parameters.step(step, 0.5)
    for time in TIMES:
        found = moved(again, gaussians, time).tensors()
        for name, x in moved(field, gaussians, time).tensors().items():
            assert torch.equal(found[name], x), name


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_missing_tensor_is_named(kind: str) -> None:
    state = strip_roles(field_state(tiny_field(kind)))
    for name in ("box", "numbers", next(name for name in state if name.startswith("learned."))):
        with pytest.raises(KeyError, match=name.removeprefix("learned.")):
            restore_field(tiny_options(kind), {k: x for k, x in state.items() if k != name}, 9, 4)
