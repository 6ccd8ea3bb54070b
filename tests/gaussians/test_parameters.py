"""Adam of a field: torch's Adam with a schedule, reordered rows and checkpoints."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dyngs.core.state import Role, strip_roles
from dyngs.gaussians import TopologyEdit
from dyngs.gaussians.optimizer import Parameters

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
def test_equals_adam_with_decaying_rate(decay: float) -> None:
    """The rate is log-linear from the first to the last; where the last is zero, linear."""
    learned = Parameters(start_values(), RATES, decay)
    num_steps = 12
    mine = {name: x.clone().requires_grad_() for name, x in start_values().items()}
    adam = torch.optim.Adam(
        [{"params": [x], "lr": RATES[name]} for name, x in mine.items()], eps=1e-15
    )
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


def test_each_tensor_has_its_own_decay() -> None:
    """Also from a checkpoint and on another device."""
    decays = {"weight": 1.0, "bias": 0.01, "planes": 0.0}
    learned = Parameters(start_values(), RATES, decays).with_state(
        strip_roles(Parameters(start_values(), RATES).state())
    )
    alone = {name: Parameters(start_values(), RATES, decay) for name, decay in decays.items()}
    for step in (1, 2):
        for one in (learned, *alone.values()):
            give_gradients(one, step)
            one.step(step, 0.5 * step)
        learned = learned.to("cpu")
    for name, one in alone.items():
        assert torch.equal(learned[name], one[name])


def test_edited_rows_keep_moments_and_new_rows_start_without() -> None:
    """Only tensors with rows per Gaussian are edited; the previous parameters are unchanged."""
    roles = dict.fromkeys(SHAPES, Role.SHARED) | {"weight": Role.PER_MOVING}
    learned = Parameters(start_values(), RATES, roles=roles)
    give_gradients(learned, 1)
    learned.step(1, 0.0)
    before = {name: x.clone() for name, x in strip_roles(learned.state()).items()}
    index = torch.tensor([3, 0, 0, 2, 3])
    is_new = torch.tensor([False, False, True, False, True])
    edited = learned.apply_edit(Role.PER_MOVING, TopologyEdit(index, is_new))
    after = strip_roles(edited.state())
    assert torch.equal(after["weight"], before["weight"][index])
    assert edited["weight"].requires_grad
    assert edited["weight"].is_leaf
    for name in ("exp_avg.weight", "exp_avg_sq.weight"):
        assert torch.equal(after[name][~is_new], before[name][index][~is_new])
        assert not after[name][is_new].any()
    assert all(torch.equal(after[name], x) for name, x in before.items() if "weight" not in name)
    assert learned.apply_edit(Role.PER_GAUSSIAN, TopologyEdit(index, is_new)) is learned, (
        "no tensor has that role"
    )
    edited["weight"].grad = torch.ones(5, 5)
    edited.step(2, 0.5)
    assert all(torch.equal(x, before[name]) for name, x in strip_roles(learned.state()).items())


def test_reordered_rows_keep_their_moments() -> None:
    """The source index of a new row need not exist."""
    learned = Parameters(start_values(), RATES)
    give_gradients(learned, 1)
    learned.step(1, 0.0)
    before = {name: x.clone() for name, x in strip_roles(learned.state()).items()}
    values = torch.randn(3, 5, generator=torch.Generator().manual_seed(2))
    source = torch.tensor([2, 99, 0])
    is_new = torch.tensor([False, True, False])
    found = strip_roles(learned.reorder({"weight": values}, source, is_new).state())
    assert torch.equal(found["weight"], values)
    for name in ("exp_avg.weight", "exp_avg_sq.weight"):
        assert torch.equal(
            found[name], torch.stack([before[name][2], torch.zeros(5), before[name][0]])
        )
    assert all(torch.equal(found[name], x) for name, x in before.items() if "weight" not in name)


def test_resumed_optimizer_equals_uninterrupted_one() -> None:
    first, second = (Parameters(start_values(), RATES, 0.1) for _ in range(2))
    for step in (1, 2, 3):
        give_gradients(first, step)
        first.step(step, step / 6)
    state = strip_roles(first.state())
    second = second.with_state(state)
    for learned in (first, second):
        for step in (4, 5):
            give_gradients(learned, step)
            learned.step(step, step / 6)
    for name, x in strip_roles(first.state()).items():
        assert torch.equal(strip_roles(second.state())[name], x), name
    for name in ("bias", "exp_avg.bias"):
        with pytest.raises(KeyError, match=name):
            second.with_state({n: x for n, x in state.items() if n != name})
