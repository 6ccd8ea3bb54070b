"""How a static scene is trained: on every image, with its 3D filter kept until it is due, and rid
of what is small."""

from __future__ import annotations

from dataclasses import replace

import torch

from dyngs.core.camera import Cameras
from dyngs.core.state import select_prefix, strip_roles
from dyngs.data.loader import Image
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.filters import FilterUpdate, filter_std, fuse_filter
from dyngs.gaussians.static_scene import StaticScene
from dyngs.gaussians.static_training import SmallGaussianPruning, StaticTraining

INTRINSICS = torch.tensor([[100.0, 0.0, 50.0], [0.0, 100.0, 50.0], [0.0, 0.0, 1.0]])


def _gaussians(z: float, n: int = 3) -> Gaussians:
    means = torch.zeros(n, 3)
    means[:, 2] = z
    return Gaussians(
        means, torch.ones(n, 4), torch.full((n, 3), -3.0), torch.zeros(n), torch.zeros(n, 1, 3)
    )


def _camera() -> Cameras:
    return Cameras(torch.eye(4)[None], INTRINSICS[None], 100, 100)


def _image(time: float | None = None) -> Image:
    return Image("view", _camera(), torch.zeros(100, 100, 3), None, None, time)


def test_without_filter_parameters_pass_through() -> None:
    training = StaticTraining(FilterUpdate())
    gaussians = _gaussians(2.0)
    scene = training.first_scene(gaussians)
    moment = training.time_step(scene, _image(), 1)
    assert moment.gaussians is gaussians
    assert moment.penalties == {}
    assert training.optimize(scene, 1) == 0
    assert training.after_step(scene, 1, True) is scene
    assert select_prefix(strip_roles(scene.state()), "model") == {}
    assert training.state() == {}


def test_nothing_depends_on_time() -> None:
    training = StaticTraining(FilterUpdate())
    assert all(training.trains_on(time, step) for time in (None, 0.0, 1.0) for step in (1, 1000))
    assert training.window(1) == (0.0, 1.0)
    scene = training.first_scene(_gaussians(2.0, 7))
    assert scene.num_moving == 0
    drawn = [training.time_step(scene, _image(time), 1).gaussians for time in (None, 0.0, 1.0)]
    assert all(x is scene.gaussians for x in drawn)


def test_the_set_is_left_to_the_strategy() -> None:
    training = StaticTraining(FilterUpdate())
    assert all(
        training.edit_scene(training.first_scene(_gaussians(2.0)), step) is None
        for step in (1, 2, 100)
    )


def _sized(pixels: list[float]) -> Gaussians:
    """Return faint Gaussians side by side at depth 2 that cover ``pixels`` px each, 2 pi o s^2. A
    unit is 50 px at that depth."""
    n = len(pixels)
    std = 3.0
    means = torch.stack([torch.linspace(-0.6, 0.6, n), torch.zeros(n), torch.full((n,), 2.0)], 1)
    opacities = torch.tensor(pixels) / (2 * torch.pi * std**2)
    scales = torch.full((n, 3), ((std**2 - 0.3) ** 0.5 / 50))
    return Gaussians(
        means, torch.ones(n, 4), scales.log(), torch.logit(opacities), torch.zeros(n, 1, 3)
    )


def test_small_gaussians_are_pruned_once() -> None:
    elsewhere = replace(
        _camera(), cam_from_world=torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))[None]
    )
    training = StaticTraining(FilterUpdate(), SmallGaussianPruning(7, 2.0, [elsewhere, _camera()]))
    scene = training.first_scene(_sized([1.5, 4.0, 1.0, 3.0]))
    assert training.edit_scene(scene, 6) is None
    assert training.edit_scene(scene, 8) is None
    found = training.edit_scene(scene, 7)
    assert found is not None
    edited, result = found
    assert torch.equal(edited.gaussians.means, scene.gaussians.means[[1, 3]])
    assert result.edit is not None
    assert torch.equal(result.edit.apply(scene.gaussians.means), edited.gaussians.means)
    assert result.message is not None
    assert result.message.startswith("pruned 2 of 4 Gaussians that cover less than 2 px in every")
    assert training.edit_scene(edited, 7) is None, "all that is left is large enough"
    assert training.edit_scene(training.first_scene(_sized([1.0, 1.5])), 7) is None, (
        "something is left of every scene"
    )


def test_the_filter_is_kept_until_it_is_due() -> None:
    training = StaticTraining(FilterUpdate([_camera()], range(100, 200, 100)))
    near = _gaussians(2.0)
    far = _gaussians(4.0)
    with_near, with_far = (fuse_filter(far, filter_std(x.means, [_camera()])) for x in (near, far))

    def drawn(scene: StaticScene) -> Gaussians:
        return training.time_step(scene.with_gaussians(far), _image(), 1).gaussians

    scene = training.after_step(training.first_scene(near).with_gaussians(far), 50, False)
    assert torch.equal(drawn(scene).log_scales, with_near.log_scales)
    scene = training.after_step(scene, 100, False)
    assert torch.equal(drawn(scene).log_scales, with_far.log_scales)
    edited = scene.with_gaussians(near).apply_edit(
        TopologyEdit.select(torch.ones(3, dtype=torch.bool))
    )
    scene = training.after_step(edited, 101, True)
    assert torch.equal(drawn(scene).log_scales, with_near.log_scales)
    scene = training.after_step(scene.with_gaussians(far), 102, True)
    assert torch.equal(drawn(scene).log_scales, with_far.log_scales), (
        "where cameras look may have changed"
    )


def test_state_goes_round() -> None:
    training = StaticTraining(FilterUpdate([_camera()]))
    first = training.first_scene(_gaussians(2.0))
    stored = select_prefix(strip_roles(first.state()), "model")
    second = training.restore(_gaussians(4.0), stored)
    drawn = (
        training.time_step(scene, _image(), 1).gaussians.log_scales for scene in (first, second)
    )
    assert torch.equal(*drawn)
