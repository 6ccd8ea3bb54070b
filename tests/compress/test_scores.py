"""Scores of 4DGS-1K: opacities over time in closed form, and what the sums over time rank first."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from camera_rings import ring_of
from tiny_fields import cloud, stirred_field, tiny_setup
from torch import Tensor

from dyngs.compress.stage import log_temporal_scores
from dyngs.deform.field import DeformationField
from dyngs.deform.gaussians_4d import Gaussians4D
from dyngs.deform.keys import Gaussians4DField
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians import Gaussians
from dyngs.gaussians.visibility import VisibilityMasks
from dyngs.ops.quaternions import quat_product, unit_quats

COUNT = 9
NUM_STATIC = 3


def moving_gaussians() -> Gaussians:
    return cloud(COUNT + NUM_STATIC).select(torch.arange(COUNT))


def field_4d(*, is_sheared: bool = True) -> Gaussians4D:
    """Nine Gaussians over space and time, which move if ``is_sheared``."""
    field = Gaussians4D(Gaussians4DField(), tiny_setup(COUNT), torch.Generator())
    generator = torch.Generator().manual_seed(1)
    own = field.parameters
    own["times"].data.uniform_(0, 1, generator=generator)
    own["log_spans"].data.uniform_(-3, 0, generator=generator)
    if is_sheared:
        own["right_quats"].data.normal_(generator=generator)
    else:
        conjugate = torch.tensor([1.0, -1.0, -1.0, -1.0])
        own["right_quats"].data.copy_(unit_quats(moving_gaussians().quats) * conjugate)
    return field


def scene_of(field: DeformationField) -> DynamicScene:
    times = tuple(k / 9 for k in range(10))
    gaussians = cloud(COUNT + NUM_STATIC)
    return DynamicScene(
        gaussians=gaussians, training_times=times, field=field, moving=torch.arange(COUNT)
    )


def variances(field: Gaussians4D) -> Tensor:
    """Variances (M,) of time, from the rotation of each axis."""
    gaussians = moving_gaussians()
    own = {name: field.parameters[name].detach().double() for name in field.parameters.values()}
    log_scales = torch.cat([own["log_spans"], gaussians.log_scales.double()], dim=1)
    left, right = (unit_quats(x.double()) for x in (gaussians.quats, own["right_quats"]))
    axes = torch.eye(4, dtype=torch.float64)
    times = [quat_product(quat_product(left, axis.expand(COUNT, 4)), right)[:, 0] for axis in axes]
    return (torch.stack(times, dim=1) * log_scales.exp()).square().sum(1)


def relative_opacity(field: DeformationField, times: Tensor) -> Tensor:
    """Opacities (M,) over those of open windows, each at its own time (M,)."""
    gaussians = moving_gaussians()
    if isinstance(field, Gaussians4D):
        elapsed = times - field.parameters["times"].detach()[:, 0].double()
        return (-0.5 * elapsed.square() / variances(field)).exp()
    now: Any = times[:, None]
    window = field.offsets(gaussians.means, now).logit_opacities
    assert window is not None
    logits = gaussians.logit_opacities.double()
    return (logits + window).sigmoid() / logits.sigmoid()


@pytest.mark.parametrize("kind", ["gaussians_4d", "free"])
def test_curvature_is_the_second_derivative(kind: str) -> None:
    """Against automatic differentiation in float64."""
    field: DeformationField = field_4d()
    if kind == "free":
        field = stirred_field("free", COUNT)
    for time in (0.0, 0.31, 0.8, 1.0):
        times = torch.full((COUNT,), time, dtype=torch.float64, requires_grad=True)
        slope = torch.autograd.grad(relative_opacity(field, times).sum(), times, create_graph=True)
        (wanted,) = torch.autograd.grad(slope[0].sum(), times)
        found = field.opacity_window(moving_gaussians(), time)
        assert found is not None
        torch.testing.assert_close(found.curvature, wanted, rtol=1e-3, atol=1e-4)


def test_the_sign_decides_what_counts_as_steady() -> None:
    """1 + exp(-2 x) by hand: with the variance 1/4, x is -4 at the mean time."""
    field = field_4d(is_sheared=False)
    field.parameters["times"].data.fill_(0.5)
    field.parameters["log_spans"].data.fill_(math.log(0.5))
    scene = replace(scene_of(field), training_times=(0.5,))
    log_volumes = scene.gaussians.log_scales.double().sum(1)
    log_volumes[:COUNT] += math.log(0.5)
    for signed, moving in ((True, 1 + math.exp(8)), (False, 1 + math.exp(-8))):
        sums = torch.tensor([moving] * COUNT + [2.0] * NUM_STATIC, dtype=torch.float64).log()
        found = log_temporal_scores(scene, signed=signed)
        torch.testing.assert_close(found, sums + 0.1 * log_volumes, rtol=1e-5, atol=1e-5)
    # in seconds of a clip of two, x is a quarter
    slower = log_temporal_scores(scene, 2.0, signed=True)[0] - 0.1 * log_volumes[0]
    assert float(slower) == pytest.approx(math.log(1 + math.exp(2)), rel=1e-5)


@pytest.mark.parametrize("signed", [True, False])
def test_extreme_variances_have_finite_scores(signed: bool) -> None:
    """From 1e-12 to 1e12, and where the exponent of float32 ends."""
    field = field_4d(is_sheared=False)
    field.parameters["times"].data.fill_(1 / 3)
    log_stds = torch.linspace(-6, 6, COUNT) * math.log(10)
    log_stds[-1] = -200.0
    field.parameters["log_spans"].data.copy_(log_stds[:, None])
    scene = scene_of(field)
    found = log_temporal_scores(scene, signed=signed)
    assert bool(found.isfinite().all())
    sums = found[:COUNT] - 0.1 * (moving_gaussians().log_scales.sum(1) + log_stds)
    # without the sign no short-lived Gaussian exceeds those that are always there
    assert (float(sums.max()) > math.log(2 * len(scene.times)) + 1e-4) is signed


@pytest.mark.parametrize("is_masked", [True, False])
def test_images_need_only_the_gaussians_of_their_time(is_masked: bool) -> None:
    scene = scene_of(field_4d())
    if is_masked:
        seen = torch.ones(2, len(scene), dtype=torch.bool)
        seen[:, ::4] = False
        scene = replace(scene, masks=VisibilityMasks.pack((0.0, 1.0), seen))
    camera = ring_of(1, np.zeros(3))
    with torch.no_grad():
        assert len(scene.drawing_step(1.0).gaussians) < len(scene.time_step(1.0).gaussians)
        for time in (0.0, 0.5, 1.0):
            every = scene.time_step(time)
            some = scene.drawing_step(time)
            assert len(some.gaussians) == int((every.gaussians.logit_opacities > -9e3).sum())
            wanted = scene.render(camera, every).rgb
            torch.testing.assert_close(scene.render(camera, time).rgb, wanted)
            assert float(wanted.max()) > 0.01
