"""The shared network: nothing at first, then what it says, only for what is drawn, and no gradient
to the geometry."""

from __future__ import annotations

from dataclasses import replace

import pytest
import reference
import torch
from scenes import random_scene
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.gaussians import Gaussians
from dyngs.gaussians.colour.network import (
    ColourNetwork,
    RestFrame,
    box_around,
    network_of,
)
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.ops.perceptron import Layer, reference_perceptron
from dyngs.ops.quaternions import rotation_matrices
from dyngs.ops.shading import Sight, num_inputs


def network(
    *, sees_time: bool = True, sees_normals: bool = True, last: float = 0.3, seed: int = 0
) -> ColourNetwork:
    """8 hidden units, float64; with ``last=0`` an untrained one."""
    g = torch.Generator().manual_seed(seed)
    inputs = num_inputs(sees_time=sees_time, sees_normals=sees_normals)

    def random(*shape: int) -> Tensor:
        return torch.randn(shape, generator=g, dtype=torch.float64)

    layers = (Layer(random(8, inputs), random(8)), Layer(last * random(3, 8), last * random(3)))
    box = torch.tensor([[0.1, 0.2, 0.3], [1.0, 2.0, 3.0]], dtype=torch.float64)
    return ColourNetwork(layers, box, sees_time, sees_normals)


def plain(gaussians: Gaussians) -> Gaussians:
    return gaussians.replace(sh=gaussians.sh[:, :1])


@pytest.mark.parametrize("sees_normals", [False, True])
def test_a_zero_last_layer_changes_nothing(sees_normals: bool) -> None:
    scene = random_scene()
    gaussians = plain(scene.gaussians)
    shader = network(last=0.0, sees_normals=sees_normals).shader(0.3)
    drawn = render(gaussians, scene.cameras, shader=shader).rgb
    torch.testing.assert_close(drawn, render(gaussians, scene.cameras).rgb, rtol=0, atol=1e-14)


def test_each_gaussian_has_the_colour_of_its_own_inputs() -> None:
    """View by view and one by one; zero for those that are not drawn."""
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
        sight = Sight(*geometry, scene.cameras.centers[v], net.box, time=0.7)
        added = reference_perceptron(reference.shading_inputs(sight, one.base_rgb), net.layers)
        torch.testing.assert_close(colors[v, i], (one.base_rgb + added)[0].clamp_min(0))


def test_colours_do_not_move_gaussians() -> None:
    """Base colours and weights get gradients; places, shapes and cameras none."""
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


def test_gradients_are_those_of_finite_differences() -> None:
    scene = random_scene(n=4, degree=0)
    net = network(last=0.05)
    bright = scene.gaussians.sh + 3
    shown = torch.ones(2, 4, 2, dtype=torch.int32)  # far from the clamp

    def shades(sh: Tensor, *parts: Tensor) -> Tensor:
        layers = tuple(Layer(*parts[i : i + 2]) for i in (0, 2))
        shader = replace(net, layers=layers).shader(0.4)
        return shader(scene.gaussians.replace(sh=sh), scene.cameras, shown)

    parts = [x.clone().requires_grad_() for layer in net.layers for x in (layer.weight, layer.bias)]
    assert torch.autograd.gradcheck(shades, (bright.requires_grad_(), *parts))


@pytest.mark.parametrize("sees_time", [False, True])
def test_time_is_seen_if_it_should_be_and_clamped(sees_time: bool) -> None:
    scene = random_scene(n=5)
    net = network(sees_time=sees_time)
    shown = torch.ones(2, 5, 2, dtype=torch.int32)

    def at(time: float | None) -> Tensor:
        return net.shader(time)(plain(scene.gaussians), scene.cameras, shown)

    assert torch.equal(at(0.2), at(0.9)) != sees_time
    assert torch.equal(at(None), at(0.0))
    assert torch.equal(at(1.0), at(7.0))
    assert torch.equal(at(0.0), at(-1.0))


def test_colours_turn_with_a_body() -> None:
    """A body and a camera turned together look the same, if the network is told how the body was at
    rest."""
    scene = random_scene(n=5)
    net = network(sees_time=False)
    gaussians = plain(scene.gaussians)
    turn = rotation_matrices(torch.tensor([[0.3, 0.5, -0.2, 0.7]], dtype=torch.float64))[0]
    shown = torch.ones(2, 5, 2, dtype=torch.int32)
    at_rest = net.shader(None, RestFrame(gaussians.means, torch.eye(3, dtype=torch.float64)))
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
    now = net.shader(None, RestFrame(gaussians.means, turn))(moved, cameras, shown)
    torch.testing.assert_close(now, at_rest(gaussians, scene.cameras, shown))


def test_a_normal_has_no_sign() -> None:
    """A quarter turn of a disc about its own plane's axis by pi turns the normal round; the colours
    stay."""
    scene = random_scene(n=5)
    net = network()
    gaussians = plain(scene.gaussians)
    flat = gaussians.replace(
        log_scales=torch.tensor([[0.0, 0.0, -5.0]], dtype=torch.float64).expand(5, 3)
    )
    a, b, c, d = flat.quats.unbind(1)
    # times i: by pi about its own x axis
    flipped = flat.replace(quats=torch.stack([-b, a, d, -c], 1))
    shown = torch.ones(2, 5, 2, dtype=torch.int32)
    colors = [net.shader(0.0)(x, scene.cameras, shown) for x in (flat, flipped)]
    torch.testing.assert_close(colors[0], colors[1])


@pytest.mark.parametrize("count", [0, 1, 300])
def test_the_box_holds_all_but_the_outermost(count: int) -> None:
    means = torch.randn(count, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [1.0, 5.0, 0.0]
    )
    if count > 100:
        means[0] = 1e6
    center, half_size = box_around(means)
    assert (half_size > 0).all()
    inside = ((means - center).abs() <= half_size * 1.001).all(1)
    assert inside.float().sum() >= 0.9 * count
    assert half_size.max() < 1e3


def test_state_goes_round() -> None:
    net = network(sees_time=False)
    state = {"box": net.box, "sees": torch.tensor([False, True])}
    for i, layer in enumerate(net.layers):
        state |= {
            f"weight{i}": layer.weight,
            f"bias{i}": layer.bias,
            f"exp_avg.weight{i}": layer.weight,
        }
    assert network_of(state) == net
    assert network_of({"frozen": torch.zeros(3)}) is None
    assert net.num_values == 6 + 8 * 13 + 8 + 3 * 8 + 3


def test_nothing_to_draw() -> None:
    scene = random_scene(n=3)
    nobody = plain(scene.gaussians).select(torch.zeros(0, dtype=torch.long))
    assert render(
        nobody, scene.cameras, RenderOptions(), shader=network().shader(None)
    ).rgb.shape == (2, 29, 37, 3)
    none = Cameras(scene.cam_from_world[:0], scene.intrinsics[:0], 4, 4)
    empty = torch.zeros(0, 3, 2, dtype=torch.int32)
    assert network().shader(None)(plain(scene.gaussians), none, empty).shape == (0, 3, 3)
