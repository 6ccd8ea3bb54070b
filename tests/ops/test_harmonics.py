"""The native spherical harmonics against the Legendre recursion of the reference."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import reference
import torch
from scenes import Scene, random_scene, weights
from torch import Tensor

from dyngs.core.conventions import SH_C0
from dyngs.core.errors import DyngsError
from dyngs.ops.harmonics import (
    dim_harmonics,
    evaluate_harmonics,
    light_harmonics,
    lit,
)

pytestmark = pytest.mark.usefixtures("one_thread")


def all_visible(scene: Scene) -> Tensor:
    return torch.ones(len(scene.cam_from_world), len(scene.means), 2, dtype=torch.int32)


def colours(scene: Scene, degree: int, function: Callable = evaluate_harmonics) -> Tensor:
    return function(scene.means, scene.cameras.centers, scene.sh, all_visible(scene), degree)


def slopes(
    scene: Scene, degree: int, function: Callable = evaluate_harmonics
) -> tuple[Tensor, ...]:
    """With respect to means, camera centres and coefficients."""
    tensors = [
        x.detach().clone().requires_grad_() for x in (scene.means, scene.cameras.centers, scene.sh)
    ]
    means, centers, sh = tensors
    colors = function(means, centers, sh, all_visible(scene), degree)
    # terms of degree 0 have no direction: 0 * x keeps them in the graph of the reference
    total = (colors * weights(colors)).sum() + 0 * (means.sum() + centers.sum())
    return torch.autograd.grad(total, tensors)


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("stored", [4, None], ids=["all stored", "just enough stored"])
def test_equals_the_reference(degree: int, stored: int | None) -> None:
    """rtol 1e-9: both float64, polynomials against a recursion."""
    scene = random_scene(n=35, views=3, seed=degree, degree=stored or degree)
    ours = colours(scene, degree)
    truth = colours(scene, degree, reference.evaluate_harmonics)
    torch.testing.assert_close(ours, truth, rtol=1e-9, atol=1e-13)
    for x, y in zip(
        slopes(scene, degree), slopes(scene, degree, reference.evaluate_harmonics), strict=True
    ):
        torch.testing.assert_close(x, y, rtol=1e-9, atol=1e-12)


def test_clamped_colours_get_no_gradient() -> None:
    scene = random_scene(n=4, views=1, degree=1)
    scene.sh[:, 0] = -10
    assert not colours(scene, 1).any()
    assert not any(x.any() for x in slopes(scene, 1))


def test_culled_gaussians_are_black_and_get_no_gradient() -> None:
    scene = random_scene(n=4, views=1, degree=1)
    radii = all_visible(scene)
    radii[0, 2] = 0
    sh = scene.sh.clone().requires_grad_()
    colors = evaluate_harmonics(scene.means, scene.cameras.centers, sh, radii, 1)
    colors.sum().backward()
    assert not colors[0, 2].any()
    assert sh.grad is not None
    assert not sh.grad[2].any()
    assert sh.grad[[0, 1, 3], 0].all()


def test_camera_in_the_centre_of_a_gaussian_gives_finite_numbers() -> None:
    scene = random_scene(n=1, views=1, degree=4)
    scene.means[:] = scene.cameras.centers
    assert colours(scene, 4).isfinite().all()
    assert all(x.isfinite().all() for x in slopes(scene, 4))


@pytest.mark.parametrize("degree", [-1, 2, 5])
def test_degree_must_be_stored(degree: int) -> None:
    with pytest.raises(DyngsError, match="degree"):
        colours(random_scene(degree=1), degree)


@pytest.mark.parametrize("terms", [1, 4])
def test_lit_colours_are_those_of_the_formula_and_so_are_gradients(terms: int) -> None:
    generator = torch.Generator().manual_seed(0)
    shapes = (6, terms, 3), (6, 3, 3), (6, 3), (8, 3)
    inputs = [
        torch.randn(x, generator=generator, dtype=torch.float64, requires_grad=True) for x in shapes
    ]
    sh, linear, normals, factors = (x.detach() for x in inputs)
    facing = torch.nn.functional.normalize((linear @ normals[..., None])[..., 0], dim=1)
    light = 1 + light_harmonics(facing) @ factors
    found = lit(sh, linear, normals, factors)
    torch.testing.assert_close(found[:, 0] * SH_C0 + 0.5, (sh[:, 0] * SH_C0 + 0.5) * light)
    torch.testing.assert_close(found[:, 1:], sh[:, 1:] * light[:, None])
    assert torch.autograd.gradcheck(lit, inputs)


def test_zero_normals_stay_finite() -> None:
    inputs = [
        x.requires_grad_()
        for x in (torch.ones(1, 1, 3), torch.eye(3)[None], torch.zeros(1, 3), torch.ones(8, 3))
    ]
    found = lit(*inputs)
    assert bool(found.isfinite().all())
    assert all(bool(x.isfinite().all()) for x in torch.autograd.grad(found.sum(), inputs))


def test_gradients_of_dimmed_colours() -> None:
    sh = torch.randn(5, 4, 3, dtype=torch.float64, requires_grad=True)
    left = torch.linspace(0, 1, 5, dtype=torch.float64, requires_grad=True)
    found = dim_harmonics(sh, left, left[::2], 2)
    torch.testing.assert_close(found[:, 0] * SH_C0 + 0.5, (sh[:, 0] * SH_C0 + 0.5) * left[:, None])
    assert torch.autograd.gradcheck(lambda x, y: dim_harmonics(x, y.detach(), y, 1), (sh, left))


def test_harmonics_of_light_have_no_mean() -> None:
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    assert light_harmonics(axes).mean(0).abs().max() < 1e-6
