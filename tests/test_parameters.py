"""Adam of a field: torch's own, with a schedule, rows that can be rearranged, and a state that can be stored."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dyngs.parameters import Parameters

RATES = {"weight": 1e-2, "bias": 3e-3, "planes": 2e-2}
SHAPES = {"weight": (4, 5), "bias": (3,), "planes": (2, 3, 4, 2)}


def start_values() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {name: torch.randn(shape, generator=generator) for name, shape in SHAPES.items()}


def give_gradients(learned: Parameters, step: int) -> dict[str, Tensor]:
    """New random gradients, the same for each step."""
    generator = torch.Generator().manual_seed(step)
    found = {}
    for name, shape in SHAPES.items():
        learned[name].grad = found[name] = torch.randn(shape, generator=generator)
    return found


@pytest.mark.parametrize("decay", [1.0, 0.01, 0.0])
def test_it_is_adam_with_a_falling_rate(decay: float) -> None:
    """The rate is log-linear from the first to the last; where the last is zero, linear."""
    learned, num_steps = Parameters(start_values(), RATES, decay), 12
    mine = {name: x.clone().requires_grad_() for name, x in start_values().items()}
    adam = torch.optim.Adam([{"params": [x], "lr": RATES[name]} for name, x in mine.items()], eps=1e-15)
    for step in range(1, num_steps + 1):
        progress = (step - 1) / (num_steps - 1)
        for name, grad in give_gradients(learned, step).items():
            mine[name].grad = grad.clone()
        factor = decay**progress if decay else 1 - progress
        for group, name in zip(adam.param_groups, mine, strict=True):
            group["lr"] = RATES[name] * factor
        adam.step()
        assert learned.step(step, progress) == 0
    for name, x in mine.items():
        torch.testing.assert_close(learned[name], x, rtol=1e-5, atol=1e-6)
        assert learned[name].grad is None


def test_rows_with_bad_gradients_are_left_out_and_counted() -> None:
    learned, before = Parameters(start_values(), RATES), start_values()
    give_gradients(learned, 1)
    for name, row in (("weight", (2, 1)), ("planes", (1, 2, 3, 0))):
        grad = learned[name].grad
        assert grad is not None
        grad[row] = float("nan")
    assert learned.step(1, 0.0) == 2
    same = {name: learned[name].detach() == x for name, x in before.items()}
    assert same["weight"].all(1).tolist() == [False, False, True, False]
    assert int(same["planes"].all(-1).sum()) == 1
    assert same["planes"][1, 2, 3].all()
    assert all(x.isfinite().all() for x in learned.state().values())


def test_what_has_no_gradient_stays() -> None:
    learned = Parameters(start_values(), RATES)
    learned["bias"].grad = torch.ones(3)
    learned.step(1, 0.0)
    for name, x in start_values().items():
        assert torch.equal(learned[name].detach(), x) == (name != "bias")
    assert learned.num_values == sum(x.numel() for x in start_values().values())
    assert "bias" in learned
    assert "slope" not in learned


def test_select_moves_rows_and_starts_new_ones_without_moments() -> None:
    learned = Parameters(start_values(), RATES)
    give_gradients(learned, 1)
    learned.step(1, 0.0)
    before = {name: x.clone() for name, x in learned.state().items()}
    index, is_new = torch.tensor([3, 0, 0, 2, 3]), torch.tensor([False, False, True, False, True])
    learned.select("weight", index, is_new)
    after = learned.state()
    assert torch.equal(after["weight"], before["weight"][index])
    assert learned["weight"].requires_grad
    assert learned["weight"].is_leaf
    for name in ("exp_avg.weight", "exp_avg_sq.weight"):
        assert torch.equal(after[name][~is_new], before[name][index][~is_new])
        assert not after[name][is_new].any()
    assert all(torch.equal(after[name], x) for name, x in before.items() if "weight" not in name)
    learned["weight"].grad = torch.ones(5, 5)
    learned.step(2, 0.5)


def test_a_restored_one_goes_on_as_if_never_stopped() -> None:
    first, second = (Parameters(start_values(), RATES, 0.1) for _ in range(2))
    for step in (1, 2, 3):
        give_gradients(first, step)
        first.step(step, step / 6)
    second.load_state({name: x.clone() for name, x in first.state().items()})
    for learned in (first, second):
        for step in (4, 5):
            give_gradients(learned, step)
            learned.step(step, step / 6)
    for name, x in first.state().items():
        assert torch.equal(second.state()[name], x), name
    state = first.state()
    del state["exp_avg.bias"]
    with pytest.raises(KeyError, match=r"exp_avg\.bias"):
        second.load_state(state)
