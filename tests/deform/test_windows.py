"""Lifetimes of Gaussians: open windows change nothing, closed ones hide, and checkpoints."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from tiny_fields import TIMES, cloud, stirred_field, tiny_options
from torch import Tensor

from dyngs.core.state import strip_roles
from dyngs.deform.field import apply_offsets
from dyngs.deform.fields import EDGE_WIDTH, OPEN_WINDOW, WindowedField, field_state, restore_field

COUNT = 9


def windowed(kind: str = "control_nodes", *, everything: bool = True) -> WindowedField:
    """A field in which each Gaussian is visible during a part of the clip."""
    field = WindowedField(stirred_field(kind, everything=everything), COUNT)
    generator = torch.Generator().manual_seed(1)
    field.edges.data[:] = torch.rand(COUNT, 2, generator=generator).sort(dim=1).values
    return field


@pytest.mark.parametrize("everything", [True, False])
def test_open_window_is_identity(everything: bool) -> None:
    others = stirred_field("control_nodes", everything=everything)
    field = WindowedField(others, COUNT)
    gaussians = cloud()
    for time in TIMES:
        before = apply_offsets(gaussians, others.offsets(gaussians.means, time))
        after = apply_offsets(gaussians, field.offsets(gaussians.means, time))
        for name, x in after.tensors().items():
            assert torch.equal(x, before.tensors()[name]), name


def test_windows_are_flat_inside_and_fall_off_outside() -> None:
    """log s((t - a) / e) + log s((b - t) / e) in float64, less that of an open one."""

    def window(a: float, b: float, time: float) -> float:
        return -math.log1p(math.exp((a - time) / EDGE_WIDTH)) - math.log1p(
            math.exp((time - b) / EDGE_WIDTH)
        )

    field = windowed(everything=False)
    means = cloud().means
    for time in (0.0, 0.2, 0.5, 0.9, 1.0):
        found = field.offsets(means, time).logit_opacities
        assert found is not None
        for (a, b), x in zip(field.edges.tolist(), found.tolist(), strict=True):
            assert x == pytest.approx(window(a, b, time) - window(*OPEN_WINDOW, time), abs=1e-4)


def test_windows_close_and_stay_within_limits() -> None:
    field = WindowedField(stirred_field("control_nodes"), COUNT)
    means = cloud().means
    began = field.edges.detach().clone()
    for step in range(1, 200):
        for time, sign in ((0.0, 1.0), (1.0, -1.0)):  # unwanted at first, wanted at last
            logits = field.offsets(means, time).logit_opacities
            assert logits is not None
            (sign * logits.sum()).backward()
        field.step(step, 0.0)
    assert bool((field.edges[:, 0] > began[:, 0]).all())
    assert torch.equal(field.edges[:, 1], began[:, 1])
    assert len(field.leaves) == 1 + len(field.inner_field.leaves)
    assert field.penalties(0.3).keys() == field.inner_field.penalties(0.3).keys()


def stored(field: WindowedField) -> dict[str, Tensor]:
    return {name: x.clone() for name, x in strip_roles(field_state(field)).items()}


def test_a_stored_field_is_the_same_field() -> None:
    field = windowed()
    means = cloud().means
    again = restore_field(tiny_options("control_nodes"), stored(field), COUNT)
    assert isinstance(again, WindowedField)
    assert stored(again).keys() == stored(field).keys()
    for name, x in stored(again).items():
        assert torch.equal(x, stored(field)[name]), name
    for name, x in vars(again.offsets(means, 0.37)).items():
        assert torch.equal(x, getattr(field.offsets(means, 0.37), name)), name
    assert again.num_values == field.num_values == field.inner_field.num_values + 2 * COUNT


@pytest.mark.parametrize(
    "change",
    [
        lambda x: x[1:],
        lambda x: x[:, :1],
        lambda x: x * float("nan"),
        lambda x: x.double(),
        lambda _: None,
    ],
)
def test_a_forged_state_is_refused(change: Callable[[Tensor], Tensor | None]) -> None:
    tensors = stored(windowed())
    forged = change(tensors.pop("windows.edges"))
    if forged is not None:
        tensors["windows.edges"] = forged
    with pytest.raises((KeyError, ValueError)):
        restore_field(tiny_options("control_nodes"), tensors, COUNT)
