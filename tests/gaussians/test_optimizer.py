"""Adam per Gaussian: equal to torch's, following edits, skipping what is not seen."""

from __future__ import annotations

import pytest
import torch

from dyngs.config import OptimConfig
from dyngs.core.state import part_of, tensors_of
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.optimizer import ADAM_EPS, GaussianOptimizer


def _gaussians(n: int, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator)

    return Gaussians(draw(n, 3), draw(n, 4), draw(n, 3), draw(n), draw(n, 4, 3))


def _stored(optimizer: GaussianOptimizer) -> dict[str, torch.Tensor]:
    """Copies of parameters and moments."""
    tensors = {
        f"gaussians.{name}": x.detach() for name, x in optimizer.parameters.tensors().items()
    }
    return {name: x.clone() for name, x in (tensors | tensors_of(optimizer.state())).items()}


def _restored(tensors: dict[str, torch.Tensor]) -> GaussianOptimizer:
    parameters = Gaussians(**part_of(tensors, "gaussians"))
    return GaussianOptimizer(_gaussians(2, seed=9), OptimConfig()).restored(parameters, tensors)


def _set_gradients(
    optimizer: GaussianOptimizer, seed: int, unseen: list[int] | None = None
) -> dict[str, torch.Tensor]:
    gradients = _gaussians(len(optimizer.parameters), seed).tensors()
    for name, x in optimizer.parameters.tensors().items():
        gradients[name][unseen or []] = 0
        x.grad = gradients[name].clone()
    return gradients


def test_equals_torch_adam_with_a_rate_per_group() -> None:
    start = _gaussians(7)
    options = OptimConfig(sparse=False)
    optimizer = GaussianOptimizer(start, options)
    theirs = {
        name: x.clone().requires_grad_() for name, x in start.tensors().items() if name != "sh"
    }
    theirs |= {
        "dc": start.sh[:, :1].clone().requires_grad_(),
        "rest": start.sh[:, 1:].clone().requires_grad_(),
    }
    rates = {
        "means": 0.3, "quats": options.lr_quats, "log_scales": options.lr_scales,
        "logit_opacities": options.lr_opacities, "dc": options.lr_sh_dc, "rest": options.lr_sh_rest,
    }  # fmt: skip
    adam = torch.optim.Adam(
        [{"params": [theirs[n]], "lr": lr} for n, lr in rates.items()], eps=ADAM_EPS
    )
    for step in range(1, 6):
        gradients = _set_gradients(optimizer, step)
        gradients |= {"dc": gradients["sh"][:, :1], "rest": gradients["sh"][:, 1:]}
        for name, x in theirs.items():
            x.grad = gradients[name].clone()
        optimizer.step(step, 0.3, dense=True)
        adam.step()
    for name, x in optimizer.parameters.tensors().items():
        expected = torch.cat([theirs["dc"], theirs["rest"]], 1) if name == "sh" else theirs[name]
        # A few float32 roundings of values of order one.
        torch.testing.assert_close(x.detach(), expected.detach(), rtol=2e-6, atol=2e-6)
        assert x.grad is None


def test_gaussians_that_rest_are_left_alone_where_they_are_not_seen() -> None:
    """Of two that are not seen only the one that rests; one that is seen moves, be it at rest else
    or not."""
    optimizer = GaussianOptimizer(_gaussians(5), OptimConfig())
    resting = torch.tensor([0, 3])
    for step in (1, 2):
        before = _stored(optimizer)
        _set_gradients(optimizer, step, unseen=[1, 3] if step == 2 else [])
        optimizer.step(step, 0.1, dense=True, resting=resting)
    for name, x in _stored(optimizer).items():
        if "." in name and name.startswith(("gaussians", "exp_avg.")):
            changed = (x != before[name]).flatten(1).any(1) if x.ndim > 1 else x != before[name]
            assert changed.tolist() == [True, True, True, False, True], name


def test_unseen_gaussians_are_left_alone_unless_dense() -> None:
    start = _gaussians(5)
    for sparse, dense, moves in ((True, False, False), (True, True, True), (False, False, True)):
        optimizer = GaussianOptimizer(start, OptimConfig(sparse=sparse))
        _set_gradients(optimizer, 1)
        optimizer.step(1, 0.1, dense=dense)
        before = _stored(optimizer)
        _set_gradients(optimizer, 2, unseen=[1, 3])
        optimizer.step(2, 0.1, dense=dense)
        for name, x in _stored(optimizer).items():
            changed = (x != before[name]).reshape(5, -1).any(1).tolist()
            assert changed == [True, moves, True, moves, True], name


def test_a_row_with_nan_gradients_is_counted_and_left_alone() -> None:
    optimizer = GaussianOptimizer(_gaussians(4), OptimConfig())
    before = optimizer.parameters.means.detach().clone()
    _set_gradients(optimizer, 1)
    assert optimizer.parameters.means.grad is not None
    optimizer.parameters.means.grad[2, 1] = float("nan")
    assert optimizer.step(1, 0.1, dense=False) == 1
    moved = (optimizer.parameters.means.detach() != before).any(1)
    assert moved.tolist() == [True, True, False, True]


def test_of_frozen_gaussians_only_the_base_colour_learns() -> None:
    optimizer = GaussianOptimizer(_gaussians(4), OptimConfig())
    frozen = torch.tensor([False, True, True, False])
    before = optimizer.parameters.sh.detach().clone()
    _set_gradients(optimizer, 1)
    optimizer.step(1, 0.1, dense=True, frozen_rest=frozen)
    changed = optimizer.parameters.sh.detach() != before
    assert changed[:, 0].all()
    assert changed[:, 1:].flatten(1).any(1).tolist() == [True, False, False, True]


@pytest.mark.parametrize("frozen", [(False, True, False), (True, True, True)])
def test_dropped_harmonics_stay_zero(frozen: tuple[bool, ...]) -> None:
    """Others keep theirs, with their moments; if nobody keeps them, there are none, in checkpoints
    neither."""
    optimizer = GaussianOptimizer(_gaussians(3), OptimConfig())
    _set_gradients(optimizer, 1)
    optimizer.step(1, 0.1, dense=True)
    before = _stored(optimizer)
    rows = torch.tensor(frozen)
    base = torch.full((3, 3), 0.7)
    optimizer.drop_rest(base, rows)
    after = _stored(optimizer)
    assert torch.equal(after["gaussians.sh"][rows, 0], base[rows])
    assert not after["gaussians.sh"][rows, 1:].any()
    for name, x in before.items():
        if not name.endswith(".sh"):
            assert torch.equal(after[name], x), name
        elif not all(frozen):
            assert torch.equal(after[name][~rows], x[~rows]), name
    terms = 1 if all(frozen) else before["gaussians.sh"].shape[1]
    assert optimizer.parameters.sh.shape == (3, terms, 3)
    other = _restored(after)
    for each in (optimizer, other):
        for x in each.parameters.tensors().values():
            x.grad = torch.ones_like(x)
        each.step(2, 0.1, dense=True, frozen_rest=rows)
        assert not each.parameters.sh[rows, 1:].any()
    assert torch.equal(optimizer.parameters.sh, other.parameters.sh)


def test_an_edit_moves_parameters_and_moments() -> None:
    optimizer = GaussianOptimizer(_gaussians(4), OptimConfig())
    _set_gradients(optimizer, 1)
    optimizer.step(1, 0.1, dense=True)
    before = _stored(optimizer)
    source = torch.tensor([0, 2, 2, 3])
    is_new = torch.tensor([False, False, True, True])
    changes = {"means": torch.full((4, 3), 7.0)}
    edit = EditResult(TopologyEdit(source, is_new), changes, frozenset({"logit_opacities"}))
    optimizer.apply(edit)
    after = _stored(optimizer)
    assert torch.equal(after["gaussians.means"], changes["means"])
    for name in ("quats", "log_scales", "logit_opacities", "sh"):
        assert torch.equal(after[f"gaussians.{name}"], before[f"gaussians.{name}"][source])
    for kind in ("exp_avg", "exp_avg_sq"):
        assert torch.equal(after[f"{kind}.sh"][:2], before[f"{kind}.sh"][source[:2]])
        assert after[f"{kind}.sh"][2:].count_nonzero() == 0
        assert after[f"{kind}.logit_opacities"].count_nonzero() == 0
    assert all(
        x.is_leaf and x.requires_grad and x.grad is None
        for x in optimizer.parameters.tensors().values()
    )


def test_a_reset_without_an_edit_keeps_all_else() -> None:
    optimizer = GaussianOptimizer(_gaussians(3), OptimConfig())
    _set_gradients(optimizer, 1)
    optimizer.step(1, 0.1, dense=True)
    before = _stored(optimizer)
    lowered = torch.full((3,), -4.0)
    optimizer.apply(EditResult(None, {"logit_opacities": lowered}, frozenset({"logit_opacities"})))
    changed = {name for name, x in _stored(optimizer).items() if not torch.equal(x, before[name])}
    assert changed == {
        "gaussians.logit_opacities",
        "exp_avg.logit_opacities",
        "exp_avg_sq.logit_opacities",
    }
    assert torch.equal(optimizer.parameters.logit_opacities.detach(), lowered)


def test_state_goes_round_to_the_bit() -> None:
    first = GaussianOptimizer(_gaussians(6), OptimConfig())
    _set_gradients(first, 1)
    first.step(1, 0.1, dense=True)
    second = _restored(_stored(first))
    for optimizer in (first, second):
        _set_gradients(optimizer, 2)
        optimizer.step(2, 0.05, dense=False)
    assert all(torch.equal(x, _stored(second)[name]) for name, x in _stored(first).items())
    with pytest.raises(KeyError):
        first.restored(first.parameters, {})


def test_a_restored_one_leaves_what_it_was_given() -> None:
    """A checkpoint in memory, or the optimizer that it was taken from."""
    first = GaussianOptimizer(_gaussians(4), OptimConfig())
    _set_gradients(first, 1)
    first.step(1, 0.1, dense=True)
    before = _stored(first)
    second = first.restored(first.parameters, tensors_of(first.state()))
    _set_gradients(second, 2)
    second.step(2, 0.1, dense=True)
    assert all(torch.equal(x, before[name]) for name, x in _stored(first).items())
    assert not torch.equal(second.parameters.means, first.parameters.means)
