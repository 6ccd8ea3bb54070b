"""Named tensors with roles: put together, taken apart, and moved to a device with all that holds
them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dyngs.core.state import (
    Role,
    StateTensor,
    add_prefix,
    move_fields_to,
    move_to_device,
    select_prefix,
    strip_roles,
    with_role,
)

NAMES = st.text("abc.", min_size=1, max_size=5)


@given(
    st.dictionaries(NAMES, st.integers(0, 9)),
    st.sampled_from(Role),
    st.text("abc", min_size=1, max_size=3),
)
def test_a_prefix_is_put_before_and_taken_away(
    values: dict[str, int], role: Role, prefix: str
) -> None:
    tensors = {name: torch.tensor([x]) for name, x in values.items()}
    state = with_role(tensors, role)
    assert all(x.role is role for x in state.values())
    assert strip_roles(state) == tensors
    assert select_prefix(strip_roles(add_prefix(prefix, state)), prefix) == tensors
    assert strip_roles(add_prefix(prefix, state)) == {
        f"{prefix}.{name}": x for name, x in tensors.items()
    }


@dataclass(frozen=True)
class Plain:
    """Has no ``to``."""

    x: Tensor
    number: float = 1.0
    cache: dict[str, Tensor] = field(default_factory=dict, init=False, compare=False)


@dataclass(frozen=True)
class Own:
    """Keeps ``times`` on the CPU."""

    times: Tensor
    x: Tensor

    def to(self, device: torch.device | str) -> Own:
        return Own(self.times, self.x.to(device))


def devices(value: Any) -> list[str]:
    return [x.device.type for x in value]


def test_moved_values_keep_their_structure() -> None:
    x = torch.arange(3.0)
    value = {
        "a": (Plain(x, 2.0), Own(x, x)),
        "b": StateTensor(x, Role.SHARED),
        "c": (),
        "d": None,
        "e": "cpu",
    }
    value["a"][0].cache["old"] = x
    moved: Any = move_to_device(value, "meta")
    plain, own = moved["a"]
    assert devices([plain.x, own.times, own.x, moved["b"].tensor]) == [
        "meta",
        "cpu",
        "meta",
        "meta",
    ]
    assert (plain.number, plain.cache, moved["b"].role) == (2.0, {}, Role.SHARED)
    assert [moved[name] for name in "cde"] == [(), None, "cpu"]
    assert devices([value["a"][0].x, value["b"].tensor]) == ["cpu", "cpu"], (
        "what was given stays as it is"
    )
    assert move_to_device(Role.SHARED, "meta") is Role.SHARED
    assert move_to_device(Plain, "meta") is Plain


@dataclass(frozen=True)
class Mixed:
    real: Tensor
    whole: Tensor
    none: Tensor | None
    name: str


def test_all_tensors_are_moved_and_only_real_ones_converted() -> None:
    given = Mixed(torch.zeros(2), torch.zeros(2).long(), None, "x")
    moved = move_fields_to(given, "meta")
    assert (moved.real.device.type, moved.whole.device.type) == ("meta", "meta")
    assert (moved.none, moved.name) == (None, "x")
    exact = move_fields_to(given, None, torch.float64)
    assert (exact.real.dtype, exact.whole.dtype, exact.real.device.type) == (
        torch.float64,
        torch.int64,
        "cpu",
    )
