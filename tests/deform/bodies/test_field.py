"""Rigid bodies within another field: rigid motion, unchanged other Gaussians, checkpoints."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tiny_fields import TIMES, cloud, stirred_field, tiny_options
from torch import Tensor

from dyngs.core.state import strip_roles
from dyngs.deform.bodies.field import BodyField, BodyRestPose
from dyngs.deform.field import apply_offsets
from dyngs.deform.fields import field_state, restore_field

CENTERS = torch.tensor([[0.2, -0.1, 0.3], [-0.4, 0.0, 0.1]])
RADII = torch.tensor([0.2, 0.3])
LABELS = torch.tensor([-1, 0, 0, 1, -1, 1, 0, -1, 1])


def field_of(kind: str = "control_nodes", points: int = 7) -> BodyField:
    generator = torch.Generator().manual_seed(0)
    places = CENTERS[:, None] + 0.3 * torch.randn(2, points, 3, generator=generator)
    quats = torch.tensor([1.0, 0, 0, 0]) + 0.5 * torch.randn(2, points, 4, generator=generator)
    rest = BodyRestPose(CENTERS, RADII, LABELS)
    return BodyField(
        stirred_field(kind),
        rest,
        {"places": places, "quats": quats, "albedo": torch.ones(len(LABELS), 3)},
    )


@pytest.mark.parametrize("kind", ["control_nodes", "hexplane"])
def test_bodies_move_rigidly_and_others_as_without_them(kind: str) -> None:
    """x' = R (x - c) + p in float64. The Gaussians rotate with their body and keep their size."""
    field = field_of(kind)
    gaussians = cloud()
    for time in TIMES:
        places, quats = (x.detach().double().numpy() for x in field.poses(time))
        turns = Rotation.from_quat(quats[:, [1, 2, 3, 0]])
        offsets = field.offsets(gaussians.means, time)
        alone = field.inner_field.offsets(gaussians.means, time)
        moved = apply_offsets(gaussians, offsets).detach()
        for body in range(2):
            own = torch.tensor([i for i, label in enumerate(LABELS.tolist()) if label == body])
            arms = (gaussians.means[own] - CENTERS[body]).double().numpy()
            expected = turns[body].apply(arms) + places[body]
            np.testing.assert_allclose(moved.means[own].numpy(), expected, atol=2e-6)
            before, after = (
                Rotation.from_quat(x[own].double().numpy()[:, [1, 2, 3, 0]])
                for x in (gaussians.quats, moved.quats)
            )
            assert (after * (turns[body] * before).inv()).magnitude().max() < 1e-5
            assert torch.equal(moved.log_scales[own], gaussians.log_scales[own])
        rest = torch.nonzero(LABELS < 0)[:, 0]
        for name, x in vars(offsets).items():
            assert torch.equal(x[rest], getattr(alone, name)[rest]), name
        assert offsets.colors is not None
        assert alone.colors is not None
        assert torch.equal(offsets.colors, alone.colors)


def test_bodies_turn_into_the_light_and_out_of_it() -> None:
    """Light from +x: irradiance follows the current x of a Gaussian relative to its body's centre."""
    field = field_of()
    means = cloud().means
    field.parameters["light"].data[0] = torch.tensor([0.5, 0.25, 0.0])
    field.parameters["albedo"].data[:] = torch.arange(1.0, 10.0)[:, None]
    for time in TIMES:
        found = field.offsets(means, time)
        alone = field.inner_field.offsets(means, time)
        assert found.colors is not None
        assert alone.colors is not None
        arms = means + found.means - field.poses(time)[0][LABELS.clamp_min(0)]
        along = torch.nn.functional.normalize(arms, dim=1)[:, 0] * (LABELS >= 0)
        lit = (torch.arange(1.0, 10.0) * along)[:, None] * torch.tensor([0.5, 0.25, 0.0])
        torch.testing.assert_close(found.colors - alone.colors, lit, atol=1e-5, rtol=0)


def test_gradients_reach_the_motion_and_the_gaussians() -> None:
    field = field_of()
    means = cloud().means.requires_grad_()
    field.parameters["light"].data[:] = 0.1
    out = field.offsets(means, 0.37)
    assert out.quats is not None
    assert out.colors is not None
    lit = field.apply_shading(cloud(), torch.arange(len(LABELS)), None, 0.37).sh.sum()
    (
        lit
        + out.means.square().sum()
        + out.quats.sum()
        + out.colors.sum()
        + sum(field.penalties(0.37).values())
    ).backward()
    assert all(x.grad is not None and bool(x.grad.any()) for x in field.parameters.leaves)
    assert means.grad is not None
    assert len(field.leaves) == len(field.parameters.leaves) + len(field.inner_field.leaves)
    before = [x.detach().clone() for x in field.leaves]
    field.step(1, 0.0)
    assert sum(not torch.equal(x, y) for x, y in zip(field.leaves, before, strict=True)) >= 3


def stored(field: BodyField) -> dict[str, Tensor]:
    return {name: x.clone() for name, x in strip_roles(field_state(field)).items()}


def test_a_stored_field_is_the_same_field() -> None:
    field = field_of()
    means = cloud().means
    again = restore_field(tiny_options("control_nodes"), stored(field), 9)
    assert isinstance(again, BodyField)
    assert stored(again).keys() == stored(field).keys()
    for name, x in stored(again).items():
        assert torch.equal(x, stored(field)[name]), name
    assert torch.equal(again.offsets(means, 0.37).means, field.offsets(means, 0.37).means)
    assert again.num_values == field.num_values


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("bodies.labels", lambda x: x + 1),
        ("bodies.labels", lambda x: x[1:]),
        ("bodies.centers", lambda x: x[:1]),
        ("bodies.learned.places", lambda x: x[:, :3]),
        ("bodies.learned.quats", lambda x: x[:, 1:]),
        ("bodies.learned.quats", lambda x: x * float("nan")),
        ("bodies.learned.places", lambda _: None),
    ],
)
def test_a_forged_state_is_refused(name: str, change: Callable[[Tensor], Tensor | None]) -> None:
    tensors = stored(field_of())
    forged = change(tensors.pop(name))
    if forged is not None:
        tensors[name] = forged
    with pytest.raises((KeyError, ValueError)):
        restore_field(tiny_options("control_nodes"), tensors, 9)
