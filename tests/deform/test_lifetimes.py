"""Time windows of Gaussians: how opacity and place follow them."""

from __future__ import annotations

import math

import pytest
import torch
from tiny_fields import cloud
from torch import Tensor

from dyngs.config import ControlNodesField
from dyngs.deform.control_nodes import ControlNodes
from dyngs.deform.field import FieldSetup, Offsets
from dyngs.deform.lifetimes import FIRST_SPAN, SIZES, lived
from dyngs.gaussians import TopologyEdit
from dyngs.state import Role


def test_a_faint_gaussian_fades_as_the_window_says_and_an_opaque_one_stays_longer() -> None:
    """In float64: of opacity 0.001, nearly 0.001 exp(-((t - mu) / s)^2 / 2)."""
    logits = torch.tensor([math.log(0.001 / 0.999), 5.0]).double()
    still = Offsets(torch.zeros(2, 3).double())
    centers, log_spans = torch.full((2, 1), 0.4).double(), torch.full((2, 1), math.log(0.1)).double()
    for time in (0.1, 0.3, 0.4, 0.65):
        found = lived(still, time, centers, log_spans, torch.zeros(2, 3).double())
        assert found.logit_opacities is not None
        shown = torch.sigmoid(logits + found.logit_opacities)
        factor = math.exp(-(((time - 0.4) / 0.1) ** 2) / 2)
        assert float(shown[0]) == pytest.approx(0.001 * factor, rel=2e-3)
        if abs(time - 0.4) < 0.2:
            assert float(shown[1]) > 0.98, "a flat top"
    assert float(shown[1]) > 5 * factor
    assert float(found.logit_opacities[0]) == pytest.approx(-0.5 * 2.5**2)


def test_it_drifts_about_its_own_moment_and_keeps_what_the_field_does() -> None:
    given = Offsets(torch.ones(1, 3), torch.full((1, 4), 0.1), None, torch.tensor([0.7]), torch.full((1, 3), 0.2))
    velocity = torch.tensor([[1.0, -2.0, 0.0]])
    found = lived(given, 0.75, torch.tensor([[0.25]]), torch.zeros(1, 1), velocity)
    assert found.means.tolist() == [[1.5, 0.0, 1.0]]
    assert found.logit_opacities is not None
    assert found.logit_opacities.tolist() == pytest.approx([0.7 - 0.125])
    assert found.quats is given.quats
    assert found.colors is given.colors


def test_gradients() -> None:
    generator = torch.Generator().manual_seed(0)
    inputs = [torch.randn(4, n, generator=generator, dtype=torch.float64).requires_grad_() for n in SIZES.values()]
    still = Offsets(torch.zeros(4, 3).double())

    def parts(*own: Tensor) -> tuple[Tensor, ...]:
        found = lived(still, 0.3, *own)
        assert found.logit_opacities is not None
        return found.means, found.logit_opacities

    assert torch.autograd.gradcheck(parts, inputs)


def field_with_lives() -> tuple[ControlNodes, ControlNodes, Tensor]:
    """A field, the same with time windows, and the Gaussians that it moves."""
    means = cloud(12).means
    setup = FieldSetup(torch.zeros(3), torch.ones(3), 10, 12, 1.5)
    field = ControlNodes(ControlNodesField(nodes=5, pieces=3, lifetimes="auto"), setup, torch.Generator())
    field.offsets(means, 0.0)
    generator = torch.Generator().manual_seed(0)
    field.parameters["means"].data += 0.2 * torch.randn(field.parameters["means"].shape, generator=generator)
    lives = field.with_lifetimes(means)
    assert lives is not None
    return field, lives, means


def test_at_first_everything_shows_all_the_time() -> None:
    field, lives, means = field_with_lives()
    for time in (0.0, 0.4, 1.0):
        before, after = field.offsets(means, time), lives.offsets(means, time)
        assert torch.equal(before.means, after.means)
        assert after.logit_opacities is not None
        assert float(after.logit_opacities.detach().min()) >= -0.5 * (0.5 / FIRST_SPAN) ** 2 - 1e-6
    assert lives.with_lifetimes(means) is None
    assert not field.has_lives


def test_windows_belong_to_their_gaussians() -> None:
    """Through edits, for those asked for, and through a file."""
    _, lives, means = field_with_lives()
    lives.parameters["life_centers"].data[:, 0] = torch.linspace(0, 1, 12)
    lives.parameters["life_log_spans"].data[:] = -2.0
    whole, rows = lives.offsets(means, 0.5), torch.tensor([7, 1, 1, 11])
    edited = lives.edited(TopologyEdit(rows, torch.tensor([False, False, True, False])))
    state = edited.state()
    assert all(state[f"learned.{name}"].role is Role.PER_MOVING for name in SIZES)
    drawn = {name: x.tensor for name, x in state.items() if x.role is not Role.TRAINING}
    setup = FieldSetup(torch.zeros(3), torch.ones(3), 10, 4, 1.5)
    again = ControlNodes(lives.options, setup, torch.Generator()).restored(drawn)
    for found in (lives.offsets(means, 0.5, rows), edited.offsets(means[rows], 0.5), again.offsets(means[rows], 0.5)):
        assert found.logit_opacities is not None
        assert whole.logit_opacities is not None
        assert torch.equal(found.logit_opacities, whole.logit_opacities[rows])
        assert torch.equal(found.means, whole.means[rows])
    with pytest.raises(KeyError):
        ControlNodes(lives.options, setup, torch.Generator()).restored(
            {name: x for name, x in drawn.items() if name != "learned.life_centers"}
        )
