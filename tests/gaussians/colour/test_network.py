"""Colour network: zero at first, evaluated for visible Gaussians, no gradient to geometry."""

from __future__ import annotations

from dataclasses import replace

import pytest
import reference
import torch
from scenes import random_scene
from torch import Tensor

from dyngs.gaussians import Gaussians
from dyngs.gaussians.colour.network import (
    ColourNetwork,
    RestPose,
)
from dyngs.gaussians.rendering import render
from dyngs.ops.perceptron import Layer, reference_perceptron
from dyngs.ops.quaternions import rotation_matrices
from dyngs.ops.shading import num_inputs


def network(
    *, uses_time: bool = True, uses_normals: bool = True, last: float = 0.3, seed: int = 0
) -> ColourNetwork:
    """A float64 network with 8 hidden units; untrained with ``last=0``."""
    g = torch.Generator().manual_seed(seed)
    inputs = num_inputs(uses_time=uses_time, uses_normals=uses_normals)

    def random(*shape: int) -> Tensor:
        return torch.randn(shape, generator=g, dtype=torch.float64)

    layers = (Layer(random(8, inputs), random(8)), Layer(last * random(3, 8), last * random(3)))
    box = torch.tensor([[0.1, 0.2, 0.3], [1.0, 2.0, 3.0]], dtype=torch.float64)
    return ColourNetwork(layers, box, uses_time, uses_normals)


def plain(gaussians: Gaussians) -> Gaussians:
    return gaussians.replace(sh=gaussians.sh[:, :1])


@pytest.mark.parametrize("uses_normals", [False, True])
def test_zero_last_layer_keeps_base_colours(uses_normals: bool) -> None:
    scene = random_scene()
    gaussians = plain(scene.gaussians)
    shader = network(last=0.0, uses_normals=uses_normals).shader(0.3)
    drawn = render(gaussians, scene.cameras, shader=shader).rgb
    torch.testing.assert_close(drawn, render(gaussians, scene.cameras).rgb, rtol=0, atol=1e-14)


def test_each_gaussian_has_the_colour_of_its_own_inputs() -> None:
    """Compared view by view and one by one. Culled Gaussians get zero."""
    scene = random_scene(n=6)
    net = network()
    gaussians = plain(scene.gaussians)
    radii = torch.ones(2, 6, 2, dtype=torch.int32)
    radii[1, 2] = 0
    colors = net.shader(0.7)(gaussians, scene.cameras, radii)
    assert colors.shape == (2, 6, 3)
    assert not colors[1, 2].any()
    for v, i in ((0, 0), (0, 5), (1, 3)):
        one = gaussians.select(torch.tensor([i]))
        geometry = (one.means, one.quats, one.log_scales, torch.tensor([0]))
        sight = reference.Sight(*geometry, scene.cameras.centers[v], net.box, time=0.7)
        added = reference_perceptron(reference.shading_inputs(one.base_rgb, *sight), net.layers)
        torch.testing.assert_close(colors[v, i], (one.base_rgb + added)[0].clamp_min(0))


def test_colours_do_not_move_gaussians() -> None:
    """Base colours and weights get gradients; means, shapes and cameras do not."""
    scene = random_scene(n=6)
    gaussians = Gaussians(
        **{k: x.clone().requires_grad_() for k, x in plain(scene.gaussians).tensors().items()}
    )
    net = network()
    for layer in net.layers:
        layer.weight.requires_grad_()
    pose = scene.cam_from_world.clone().requires_grad_()
    cameras = replace(scene.cameras, cam_from_world=pose)
    net.shader(0.2)(gaussians, cameras, torch.ones(2, 6, 2, dtype=torch.int32)).sum().backward()
    assert pose.grad is None
    assert gaussians.sh.grad is not None
    assert all(layer.weight.grad is not None for layer in net.layers)
    for name, x in gaussians.tensors().items():
        assert (x.grad is None) == (name != "sh"), name


def test_colours_turn_with_a_body() -> None:
    """A body rotated together with the camera looks the same, given its rest pose."""
    scene = random_scene(n=5)
    net = network(uses_time=False)
    gaussians = plain(scene.gaussians)
    turn = rotation_matrices(torch.tensor([[0.3, 0.5, -0.2, 0.7]], dtype=torch.float64))[0]
    shown = torch.ones(2, 5, 2, dtype=torch.int32)
    at_rest = net.shader(None, RestPose(gaussians.means, torch.eye(3, dtype=torch.float64)))
    w, x, y, z = torch.nn.functional.normalize(
        torch.tensor([0.3, 0.5, -0.2, 0.7], dtype=torch.float64), dim=0
    )
    a, b, c, d = gaussians.quats.unbind(1)
    quats = [
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ]
    moved = gaussians.replace(means=gaussians.means @ turn.T + 2.0, quats=torch.stack(quats, 1))
    world_from_world = torch.eye(4, dtype=torch.float64)
    world_from_world[:3, :3], world_from_world[:3, 3] = turn, 2.0
    cameras = replace(
        scene.cameras, cam_from_world=scene.cam_from_world @ torch.linalg.inv(world_from_world)
    )
    now = net.shader(None, RestPose(gaussians.means, turn))(moved, cameras, shown)
    torch.testing.assert_close(now, at_rest(gaussians, scene.cameras, shown))
