"""Adam per Gaussian: equal to torch's, follows edits, skips unseen rows."""

from __future__ import annotations

import pytest
import torch

from dyngs.config import OptimConfig
from dyngs.core.state import select_prefix, strip_roles
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.optimizer import GaussianOptimizer


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
    return {name: x.clone() for name, x in (tensors | strip_roles(optimizer.state())).items()}


def _restored(tensors: dict[str, torch.Tensor]) -> GaussianOptimizer:
    parameters = Gaussians(**select_prefix(tensors, "gaussians"))
    return GaussianOptimizer(_gaussians(2, seed=9), OptimConfig()).with_state(parameters, tensors)


def _set_gradients(
    optimizer: GaussianOptimizer, seed: int, unseen: list[int] | None = None
) -> dict[str, torch.Tensor]:
    gradients = _gaussians(len(optimizer.parameters), seed).tensors()
    for name, x in optimizer.parameters.tensors().items():
        gradients[name][unseen or []] = 0
        x.grad = gradients[name].clone()
    return gradients


def test_unseen_rows_are_skipped() -> None:
    """Rows in ``skip_unseen_rows`` are skipped while unseen; seen rows are always updated."""
    optimizer = GaussianOptimizer(_gaussians(5), OptimConfig())
    skip_unseen_rows = torch.tensor([0, 3])
    for step in (1, 2):
        before = _stored(optimizer)
        _set_gradients(optimizer, step, unseen=[1, 3] if step == 2 else [])
        optimizer.step(step, 0.1, skip_unseen_rows=skip_unseen_rows)
    for name, x in _stored(optimizer).items():
        if "." in name and name.startswith(("gaussians", "exp_avg.")):
            changed = (x != before[name]).flatten(1).any(1) if x.ndim > 1 else x != before[name]
            assert changed.tolist() == [True, True, True, False, True], name


def test_of_frozen_gaussians_only_the_base_colour_learns() -> None:
    optimizer = GaussianOptimizer(_gaussians(4), OptimConfig())
    frozen = torch.tensor([False, True, True, False])
    before = optimizer.parameters.sh.detach().clone()
    _set_gradients(optimizer, 1)
    optimizer.step(1, 0.1, frozen_harmonics=frozen)
    changed = optimizer.parameters.sh.detach() != before
    assert changed[:, 0].all()
    assert changed[:, 1:].flatten(1).any(1).tolist() == [True, False, False, True]


@pytest.mark.parametrize("frozen", [(False, True, False), (True, True, True)])
def test_dropped_harmonics_stay_zero(frozen: tuple[bool, ...]) -> None:
    """Other rows keep SH and moments. If no row keeps any, SH are removed, from checkpoints too."""
    optimizer = GaussianOptimizer(_gaussians(3), OptimConfig())
    _set_gradients(optimizer, 1)
    optimizer.step(1, 0.1)
    before = _stored(optimizer)
    rows = torch.tensor(frozen)
    base = torch.full((3, 3), 0.7)
    optimizer.drop_harmonics(base, rows)
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
        each.step(2, 0.1, frozen_harmonics=rows)
        assert not each.parameters.sh[rows, 1:].any()
    assert torch.equal(optimizer.parameters.sh, other.parameters.sh)


def test_an_edit_moves_parameters_and_moments() -> None:
    optimizer = GaussianOptimizer(_gaussians(4), OptimConfig())
    _set_gradients(optimizer, 1)
    optimizer.step(1, 0.1)
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
