"""Deformation of 4D Gaussians by view and time: products, invariances, gradients and storage."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from scenes import random_scene
from tiny_fields import cloud
from torch import Tensor

from dyngs.compress.measure import quantize_tensors
from dyngs.core.state import select_prefix, strip_roles
from dyngs.deform.field import FieldSetup, MovingRows
from dyngs.deform.fields import create_field, field_state, restore_field
from dyngs.deform.gaussians_4d import Gaussians4D
from dyngs.deform.keys import DynamicModel, Gaussians4DField
from dyngs.deform.predictor import predict_changes
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians import Gaussians
from dyngs.gaussians.visibility import VisibilityMasks
from dyngs.runs.stored_file import tensors_to_store, to_checkpoint_tensors

COUNT = 9
CENTER = torch.tensor([0.3, -0.2, 0.1])
EYE = torch.tensor([4.0, 1.0, -3.0])
OPTIONS = Gaussians4DField(predictor_width=8)


def make_field(options: Gaussians4DField = OPTIONS, unit: float = 1.0) -> Gaussians4D:
    """An untrained field whose box is measured in 1 / ``unit`` world units."""
    setup = FieldSetup(unit * CENTER, torch.full((3,), 2 * unit), 10, COUNT, 1.5 * unit, 4)
    field = create_field(options, setup, torch.Generator().manual_seed(1))
    assert isinstance(field, Gaussians4D)
    return field


def trained_field(unit: float = 1.0) -> Gaussians4D:
    field = make_field(unit=unit)
    generator = torch.Generator().manual_seed(2)
    for x in field.parameters.values().values():
        x += 0.2 * torch.randn(x.shape, generator=generator)
    return field


def at(field: Gaussians4D, gaussians: Gaussians, eye: Tensor | None = EYE) -> Gaussians:
    moving = MovingRows(gaussians.means, None, None)
    return field.deform(gaussians, moving, 0.4, eye=eye).gaussians


def assert_same(one: Gaussians, other: Gaussians) -> None:
    for name, x in one.tensors().items():
        torch.testing.assert_close(x, other.tensors()[name], rtol=1e-4, atol=1e-5)


def test_an_untrained_predictor_changes_nothing() -> None:
    plain = make_field(Gaussians4DField())
    for eye in (EYE, None):
        found = at(make_field(), cloud(), eye).tensors()
        assert all(torch.equal(found[n], x) for n, x in at(plain, cloud(), eye).tensors().items())


def test_known_factors_multiply_the_4d_gaussian() -> None:
    """Means are multiplied about the centre of the box, times about the middle of the clip."""
    field = make_field()
    plain = make_field(Gaussians4DField())
    factors = 1 + 0.02 * torch.arange(1.0, 17.0)
    scale_rows = slice(4, 8)
    changes = factors - 1
    changes[scale_rows] = factors[scale_rows].log()
    field.parameters.values()["joined_bias2"].copy_(changes)
    own = plain.parameters.values()
    own["times"].copy_(0.5 + (own["times"] - 0.5) * factors[3])
    own["log_spans"] += factors[7].log()
    own["right_quats"] *= factors[12:]
    gaussians = cloud()
    multiplied = gaussians.replace(
        means=CENTER + (gaussians.means - CENTER) * factors[:3],
        log_scales=gaussians.log_scales + factors[4:7].log(),
        quats=gaussians.quats * factors[8:12],
    )
    found = at(field, gaussians)
    assert_same(found, at(plain, multiplied))


@pytest.mark.parametrize("unit", [1e-3, 1e4])
def test_factors_do_not_depend_on_the_unit_of_length(unit: float) -> None:
    shift = torch.tensor(unit).log()
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(COUNT, 4)  # no axis in space and time
    gaussians = cloud().replace(quats=upright)
    scaled = gaussians.replace(
        means=unit * gaussians.means, log_scales=gaussians.log_scales + shift
    )
    fields = trained_field(), trained_field(unit)
    for field in fields:
        values = field.parameters.values()
        values["right_quats"].copy_(upright)
        values["joined_weight2"][8:] = 0
        values["joined_bias2"][8:] = 0
    wanted = at(fields[0], gaussians)
    found = at(fields[1], scaled, unit * EYE)
    back = found.replace(means=found.means / unit, log_scales=found.log_scales - shift)
    assert_same(back.replace(quats=wanted.quats), wanted)


def scene_of(field: Gaussians4D) -> DynamicScene:
    moving = torch.arange(COUNT)
    times = (0.0, 0.5, 1.0)
    return DynamicScene(gaussians=cloud(), training_times=times, field=field, moving=moving)


def seen_from(scene: DynamicScene, eye: Tensor) -> Gaussians:
    now = scene.time_step(0.4)
    assert now.from_eye is not None
    return now.from_eye(eye)


def test_each_view_of_a_scene_has_its_own_gaussians() -> None:
    """Views of one call equal single ones, also from a time step; ``at`` is the view without a
    camera."""
    cameras = random_scene(n=COUNT, views=2).to(torch.float32).cameras
    scene = scene_of(trained_field())
    with torch.no_grad():
        both = scene.render(cameras, 0.4).rgb
        now = scene.time_step(0.4)
        for i in range(2):
            view = cameras.select(i)
            assert torch.equal(scene.render(view, now).rgb[0], both[i])
            assert_same(
                seen_from(scene, view.centers[0]), at(trained_field(), cloud(), view.centers[0])
            )
        assert_same(scene.at(0.4), at(trained_field(), cloud(), None))
    first, second = (seen_from(scene, center).means for center in cameras.centers)
    assert float((first - second).abs().max()) > 1e-3


def test_masked_gaussians_do_not_reach_the_predictor() -> None:
    scene = scene_of(trained_field())
    seen = torch.rand(3, COUNT, generator=torch.Generator().manual_seed(1)) < 0.4
    masked = replace(scene, masks=VisibilityMasks.pack((0.0, 0.5, 1.0), seen))
    found = seen_from(masked, EYE)
    assert_same(found, seen_from(scene, EYE).select(seen[:2].any(0)))


def test_gradients_stop_at_the_inputs_of_the_network() -> None:
    """The gradient of a mean is its factor, 0 if the Gaussian is not drawn; the camera has none."""
    field = trained_field()
    field.parameters.values()["times"][0] = 5.0  # long after the clip
    gaussians = cloud()
    means = gaussians.means.clone().requires_grad_()
    eye = EYE.clone().requires_grad_()
    found = at(field, gaussians.replace(means=means), eye)
    found.means.sum().backward()
    assert eye.grad is None
    with torch.no_grad():
        changes = predict_changes(
            field.parameters,
            field.setup.normalize(gaussians.means),
            field.parameters["times"],
            torch.nn.functional.normalize(gaussians.means - EYE, dim=1),
            torch.full((1, 1), 0.4),
        )
    drawn = found.opacities.detach()[:, None] > 0
    assert not drawn[0]
    assert drawn.any()
    torch.testing.assert_close(means.grad, torch.where(drawn, 1 + changes[:, :3], 0.0))


def test_weights_decay_towards_zero() -> None:
    """A weight of 1 has a gradient of 1e-6 without any loss."""
    field = make_field()
    weight = field.parameters["joined_weight2"]
    weight.data.fill_(1.0)
    for x in field.leaves:
        x.grad = torch.zeros_like(x)
    field.step(1, 0.0)
    moments = strip_roles(field.state())
    torch.testing.assert_close(
        moments["learned.exp_avg.joined_weight2"], torch.full_like(weight, 1e-7)
    )
    assert not moments["learned.exp_avg.times"].any()


def test_a_stored_predictor_gives_the_same_gaussians() -> None:
    field = trained_field()
    state = strip_roles(field_state(field))
    restored = restore_field(OPTIONS, state, COUNT, 4)
    assert isinstance(restored, Gaussians4D)
    for name, x in at(field, cloud()).tensors().items():
        assert torch.equal(at(restored, cloud()).tensors()[name], x)
    with pytest.raises(KeyError):
        restore_field(
            OPTIONS, {n: x for n, x in state.items() if "joined_bias2" not in n}, COUNT, 4
        )


def test_a_stored_scene_keeps_each_number_of_the_rotations() -> None:
    """Files turn rotations of other Gaussians by halves, which the predictor would notice."""
    scene = scene_of(trained_field())
    exact = tensors_to_store(scene)
    steps = {"gaussians.quats": 2**-12, "model.field.left_quats": 2**-12}
    tensors = to_checkpoint_tensors(
        quantize_tensors(exact, dict.fromkeys(exact, 0.0) | steps, exact)
    )
    stored = DynamicScene.from_state(
        DynamicModel(deform=OPTIONS),
        Gaussians.stored(select_prefix(tensors, "gaussians")),
        select_prefix(tensors, "model"),
    )
    found = seen_from(stored, EYE)
    wanted = seen_from(scene, EYE)
    torch.testing.assert_close(found.means, wanted.means, rtol=0, atol=2e-2)
    torch.testing.assert_close(stored.gaussians.quats, cloud().quats, rtol=0, atol=2**-12)


def test_lines_are_the_gaussians_at_their_mean_times_without_a_camera() -> None:
    field = trained_field()
    field.parameters.values()["times"].fill_(0.4)
    lines = field.linear(cloud())
    wanted = at(field, cloud(), None)
    delay = 0.4 - lines.times[:, None]
    assert float(delay.abs().min()) > 0
    moved = lines.gaussians.means + lines.velocities * delay
    torch.testing.assert_close(moved, wanted.means, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(lines.gaussians.log_scales, wanted.log_scales, rtol=1e-4, atol=1e-5)
