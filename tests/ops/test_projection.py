"""Projection against the reference in float64, on every instruction set, and culling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import Scene, random_scene, relative_error, weights
from torch import Tensor

from dyngs.ops.projection import (
    Projection,
    ProjectionOptions,
    project,
)

pytestmark = pytest.mark.usefixtures("one_thread")

OUTPUTS = ("means2d", "depths", "factors", "compensations")
INPUTS = ("means", "quats", "scales", "cam_from_world", "intrinsics")
DEFAULTS = ProjectionOptions()


def splats(
    scene: Scene, options: ProjectionOptions = DEFAULTS, function: Callable = project
) -> Projection:
    return function(scene.means, scene.quats, scene.scales, scene.opacities, scene.cameras, options)


def slopes(
    scene: Scene, options: ProjectionOptions = DEFAULTS, function: Callable = project
) -> list[Tensor]:
    """Gradients of a weighted sum of all outputs with respect to INPUTS."""
    leaves = scene.leaves()
    p = splats(leaves, options, function)
    total = torch.stack(
        [(getattr(p, name) * weights(getattr(p, name))).sum() for name in OUTPUTS]
    ).sum()
    return list(torch.autograd.grad(total, [getattr(leaves, name) for name in INPUTS]))


def visible(p: Projection) -> Tensor:
    return p.radii[..., 0] > 0


def front(n: int = 1, dtype: torch.dtype = torch.float64) -> Scene:
    """n copies of a ball on the axis of one camera at the origin, 3 units in front of it; 32x32
    px."""
    scene = random_scene(n=n, views=1, size=(32, 32)).to(dtype)
    means = torch.zeros_like(scene.means)
    means[:, 2] = 3
    intrinsics = scene.intrinsics.clone()
    intrinsics[:, :2, 2] = 16
    intrinsics[:, 1, 1] = intrinsics[:, 0, 0]
    return replace(
        scene,
        means=means,
        scales=torch.full_like(scene.scales, 0.1),
        opacities=torch.full_like(scene.opacities, 0.5),
        cam_from_world=torch.eye(4, dtype=dtype)[None],
        intrinsics=intrinsics,
    )


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    antialiased=st.booleans(),
    eps2d=st.sampled_from([0.1, 0.3, 2.0]),
    alpha_min=st.sampled_from([0.0, 1 / 255]),
)
def test_equals_the_reference(seed: int, antialiased: bool, eps2d: float, alpha_min: float) -> None:
    """rtol 1e-9: both are float64; needles and the clamp of the Jacobian are among the random
    Gaussians."""
    scene = random_scene(n=33, views=3, seed=seed)
    scene = replace(
        scene,
        means=2 * scene.means,
        scales=scene.scales * torch.logspace(-2, 1, 33).double()[:, None],
    )
    options = ProjectionOptions(eps2d=eps2d, antialiased=antialiased, alpha_min=alpha_min)
    ours = splats(scene, options)
    truth = splats(scene, options, reference.project)
    assert torch.equal(ours.radii, truth.radii)
    for name in OUTPUTS:
        torch.testing.assert_close(getattr(ours, name), getattr(truth, name), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(ours.conics, truth.conics, rtol=1e-9, atol=1e-12)
    for name, x, y in zip(
        INPUTS, slopes(scene, options), slopes(scene, options, reference.project), strict=True
    ):
        assert relative_error(x, y) < 1e-9, name


def test_many_cameras_equal_one_at_a_time(scene: Scene) -> None:
    together = splats(scene)
    for v in range(2):
        alone = splats(scene.view(v))
        for name in (*OUTPUTS, "radii"):
            assert torch.equal(getattr(alone, name)[0], getattr(together, name)[v])


@pytest.mark.parametrize("name", ["cam_from_world", "intrinsics"])
def test_gradient_of_one_part_of_the_camera(name: str, scene: Scene) -> None:
    """Optimising only poses or only intrinsics gives the same gradients."""
    part = getattr(scene, name).clone().requires_grad_()
    p = splats(replace(scene, **{name: part}))
    total = torch.stack([(getattr(p, x) * weights(getattr(p, x))).sum() for x in OUTPUTS]).sum()
    assert torch.equal(torch.autograd.grad(total, part)[0], slopes(scene)[INPUTS.index(name)])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_near_and_far_are_open_bounds(dtype: torch.dtype) -> None:
    scene = front(4, dtype)
    scene.means[:, 2] = torch.tensor([0.5, 0.5001, 7.9999, 8.0])
    p = splats(scene, ProjectionOptions(near=0.5, far=8.0))
    assert visible(p)[0].tolist() == [False, True, True, False]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_faint_and_small_splats_are_culled(dtype: torch.dtype) -> None:
    scene = front(3, dtype)
    scene.opacities[:] = torch.tensor([1 / 255, 1.001 / 255, 1.0], dtype=dtype)
    assert visible(splats(scene))[0].tolist() == [False, True, True]
    assert visible(splats(scene, ProjectionOptions(radius_clip=3.0)))[0].tolist() == [
        False,
        False,
        True,
    ]


def test_culled_rows_are_zero_and_get_no_gradient() -> None:
    scene = front(2)
    scene.means[1, 2] = -3
    p = splats(scene)
    assert not any(getattr(p, name)[0, 1].any() for name in (*OUTPUTS, "radii"))
    assert not any(x[1].any() for x in slopes(scene)[:3])


def test_extent_holds_every_pixel_that_is_drawn() -> None:
    """Alpha just outside the extent is below alpha_min, just inside (half extents are rounded up by
    at most 1) not."""
    scene = random_scene(n=50, views=1)
    p = splats(scene)
    seen = visible(p)[0]
    covariance = torch.linalg.inv(
        torch.stack([p.conics[0, seen][:, [0, 1]], p.conics[0, seen][:, [1, 2]]], 1)
    )
    reach = (2 * (scene.opacities[seen] * 255).log())[:, None] * covariance.diagonal(dim1=1, dim2=2)
    assert (p.radii[0, seen] >= reach.sqrt() - 1e-9).all()
    assert (p.radii[0, seen] < reach.sqrt() + 1).all()


def test_antialiased_extent_uses_the_compensated_opacity() -> None:
    scene = front(1)
    scene.scales[:] = 1e-3  # compensation about 0.0003 / 0.3
    assert visible(splats(scene)).all()
    assert not visible(splats(scene, ProjectionOptions(antialiased=True))).any()


def test_compensation_is_the_share_of_light_before_the_low_pass() -> None:
    scene = front(1)
    bare = (float(scene.intrinsics[0, 0, 0]) * 0.1 / 3) ** 2
    p = splats(scene)
    assert p.compensations.item() == pytest.approx(bare / (bare + 0.3), rel=1e-12)
    assert splats(scene, ProjectionOptions(eps2d=0.0)).compensations.item() == pytest.approx(
        1, rel=1e-12
    )
