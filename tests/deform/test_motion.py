"""Motion scores in pixels for known displacements, and freezing of static Gaussians."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from scipy.spatial.transform import Rotation
from tiny_fields import cloud, stirred_field, tiny_setup
from torch import Tensor

from dyngs.deform.field import DeformationField, Offsets, apply_offsets
from dyngs.deform.training import PX_PER_OPACITY, bake_, measure_motion
from dyngs.gaussians.optimizer import Parameters

TIMES = tuple(i / 10 for i in range(11))


class Scripted(DeformationField):
    """A field given by a function of time. Records the times at which it is evaluated."""

    def __init__(self, script: Callable[[Tensor, float], Offsets]) -> None:
        self.script, self.asked = script, list[float]()
        self.setup, self.parameters = tiny_setup(), Parameters({}, {})

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        self.asked.append(time)
        return self.script(means, time)


def filled(count: int, *values: float) -> Tensor:
    return torch.tensor(values).expand(count, len(values))


def score(script: Callable[[Tensor, float], Offsets], px_size: Tensor | None = None) -> Tensor:
    gaussians = cloud(4)
    size = torch.ones(4) if px_size is None else px_size
    return measure_motion(Scripted(script), gaussians, TIMES, size)[0]


def static(means: Tensor) -> Tensor:
    return torch.zeros_like(means)


def test_score_of_a_circular_path_is_its_radius() -> None:
    def circle(means: Tensor, t: float) -> Offsets:
        turn = Rotation.from_rotvec([0, 0, 2 * torch.pi * t]).apply([0.2, 0.0, 0.0])
        return Offsets(filled(len(means), *turn.tolist()))

    even = tuple(i / 16 for i in range(16))
    found = measure_motion(Scripted(circle), cloud(4), even, torch.ones(4))[0]
    torch.testing.assert_close(found, torch.full((4,), 0.2))


def test_rotation_and_scaling_scores_grow_with_the_size() -> None:
    """A rotation by 0.02 rad moves the end of the longest axis by 0.02 of its length. Its
    quaternion offset is (0, 0, 0, 0.01).
    """
    longest = cloud(4).scales.amax(1)

    def turn(means: Tensor, t: float) -> Offsets:
        return Offsets(static(means), filled(len(means), 0.0, 0.0, 0.0, 0.01 * (2 * t - 1)))

    def growth(means: Tensor, t: float) -> Offsets:
        return Offsets(static(means), None, filled(len(means), 0.0, 0.1 * (2 * t - 1), 0.0))

    torch.testing.assert_close(score(turn), 0.02 * longest)
    torch.testing.assert_close(score(growth), 0.1 * longest)


def test_opacity_and_colour_scores_ignore_the_pixel_size() -> None:
    gaussians = cloud(4)

    def fade(means: Tensor, t: float) -> Offsets:
        return Offsets(static(means), logit_opacities=torch.full((len(means),), 2 * t - 1))

    def blush(means: Tensor, t: float) -> Offsets:
        return Offsets(static(means), colors=filled(len(means), 0.1 * (2 * t - 1), 0.0, 0.05 * t))

    px_size = torch.tensor([0.01, 0.1, 1.0, 0.3])
    logits = gaussians.logit_opacities
    change = torch.maximum(
        (logits + 1).sigmoid() - logits.sigmoid(), logits.sigmoid() - (logits - 1).sigmoid()
    )
    torch.testing.assert_close(score(fade, px_size), PX_PER_OPACITY * change)
    torch.testing.assert_close(score(blush, px_size), torch.full((4,), 0.1 * PX_PER_OPACITY))


@pytest.mark.parametrize("everything", [True, False])
def test_baking_freezes_at_the_mean(everything: bool) -> None:
    """Baked rows take the mean over time of the deformed parameters. Other rows do not change."""
    gaussians = cloud()
    field = stirred_field("control_nodes", everything=everything)
    mean = measure_motion(field, gaussians, TIMES, torch.ones(9))[1]
    samples = [field.offsets(gaussians.means, t).means.detach() for t in TIMES]
    torch.testing.assert_close(mean.means, torch.stack(samples).mean(0))
    rows = torch.tensor([1, 4, 8])
    expected = apply_offsets(gaussians, mean.select(rows), rows)
    baked = gaussians.replace(
        **{k: x.clone().requires_grad_() for k, x in gaussians.tensors().items()}
    )
    bake_(baked, rows, mean.select(rows))
    for name, x in expected.tensors().items():
        assert torch.equal(getattr(baked, name).detach(), x), name
        assert getattr(baked, name).requires_grad
    others = torch.tensor([0, 2, 3, 5, 6, 7])
    assert torch.equal(baked.means[others], gaussians.means[others])
    bake_(baked, torch.zeros(0).long(), mean.select(torch.zeros(0).long()))
    assert torch.equal(baked.quats.detach(), expected.quats)
