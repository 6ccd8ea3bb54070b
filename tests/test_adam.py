"""Adam of named tensors: torch's Adam with skipped rows."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dyngs.core.state import strip_roles
from dyngs.gaussians.optimizer import AdamState
from dyngs.ops.adam import Count

SHAPES = {"weight": (4, 5), "bias": (3,), "planes": (2, 3, 4, 2)}
EPS = 1e-15


def random(shape: tuple[int, ...], seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def start_values() -> dict[str, Tensor]:
    return {
        name: random(shape, seed).requires_grad_()
        for seed, (name, shape) in enumerate(SHAPES.items())
    }


def stepped(steps: int) -> tuple[AdamState, dict[str, Tensor]]:
    """Moments and tensors after some steps."""
    tensors = start_values()
    adam = AdamState.zero(tensors)
    for step in range(1, steps + 1):
        for seed, (name, x) in enumerate(tensors.items()):
            x.grad = random(x.shape, 10 * step + seed)
            assert adam.step_(name, x, lr=0.1, step=step) == 0
    return adam, tensors


def stepped_along(last_axis: bool, adam: AdamState, name: str, x: Tensor, step: int) -> Count:
    return adam.steps_([adam.update(name, x, 0.1, along_last_axis=last_axis)], step=step)


@pytest.mark.parametrize("along_last_axis", [False, True])
def test_equals_torch_adam(along_last_axis: bool) -> None:
    mine = start_values()
    theirs = start_values()
    adam = AdamState.zero(mine)
    reference = torch.optim.Adam(list(theirs.values()), lr=0.1, eps=EPS)
    for step in range(1, 6):
        for seed, name in enumerate(SHAPES):
            grad = random(SHAPES[name], 10 * step + seed)
            mine[name].grad, theirs[name].grad = grad, grad.clone()
            assert stepped_along(along_last_axis, adam, name, mine[name], step) == 0
        reference.step()
    for name, x in theirs.items():
        torch.testing.assert_close(mine[name], x, rtol=1e-5, atol=1e-6)
        assert mine[name].grad is None


def test_map_changes_both_moments_of_named_tensors() -> None:
    adam, _ = stepped(2)
    some, everything, nothing = (
        adam.map(torch.zeros_like, names) for names in (["bias"], None, [])
    )
    for part in ("exp_avg", "exp_avg_sq"):
        before, found, all_zero, same = (
            getattr(one, part) for one in (adam, some, everything, nothing)
        )
        for name, x in before.items():
            assert x.any(), "what is mapped stays as it is"
            assert torch.equal(found[name], torch.zeros_like(x) if name == "bias" else x)
            assert not all_zero[name].any()
            assert torch.equal(same[name], x)


def test_resumed_optimizer_equals_uninterrupted_one() -> None:
    adam, tensors = stepped(2)
    copies = {name: x.detach().clone().requires_grad_() for name, x in tensors.items()}
    other = AdamState.from_state(strip_roles(adam.state()), tensors)
    for one, own in ((adam, tensors), (other, copies)):
        for name, x in own.items():
            x.grad = random(x.shape, 99)
            one.step_(name, x, lr=0.1, step=3)
    assert all(torch.equal(x, copies[name]) for name, x in tensors.items())
    for name, x in strip_roles(adam.state()).items():
        assert torch.equal(x, strip_roles(other.state())[name])
        assert torch.equal(x, strip_roles(other.to("cpu").state())[name])


@pytest.mark.parametrize("part", ["exp_avg", "exp_avg_sq"])
def test_moments_that_do_not_fit_are_refused(part: str) -> None:
    adam, tensors = stepped(1)
    state = strip_roles(adam.state())
    name = f"{part}.weight"
    with pytest.raises(KeyError, match=name):
        AdamState.from_state({k: x for k, x in state.items() if k != name}, tensors)
    bad = (
        torch.full((4, 5), float("nan")),
        torch.zeros(5, 5),
        torch.zeros(4, 5, dtype=torch.float64),
    )
    for x in bad:
        with pytest.raises(ValueError, match=name):
            AdamState.from_state(state | {name: x}, tensors)
