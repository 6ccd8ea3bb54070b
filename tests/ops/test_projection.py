"""The native projection: against the reference in float64, on every instruction set, and what it
culls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import Scene, look_around, random_scene, relative_error, weights
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.ops.projection import (
    Projection,
    ProjectionOptions,
    project,
    project_backward_op,
    project_op,
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


def test_gradcheck() -> None:
    options = ProjectionOptions(alpha_min=0.0)
    leaves = random_scene(n=3, views=2).leaves()

    def run(*tensors: Tensor) -> tuple[Tensor, ...]:
        p = splats(replace(leaves, **dict(zip(INPUTS, tensors, strict=True))), options)
        return p.means2d, p.depths, p.factors, p.compensations

    assert torch.autograd.gradcheck(run, [getattr(leaves, name) for name in INPUTS])


def test_float_equals_double_on_every_isa(isa: str) -> None:
    """1e-5: rounding, 6e-8 per operation, times the condition of the formulas (x/z of points near
    the camera)."""
    scene = random_scene(n=200).to(torch.float32)
    truth_scene = scene.to(torch.float64)
    options = ProjectionOptions(alpha_min=0.0)
    ours = splats(scene, options)
    truth = splats(truth_scene, options)
    assert torch.equal(visible(ours), visible(truth))
    for name in OUTPUTS:
        assert relative_error(getattr(ours, name), getattr(truth, name)) < 1e-5, name
    for name, x, y in zip(
        INPUTS, slopes(scene, options), slopes(truth_scene, options), strict=True
    ):
        assert relative_error(x, y) < 1e-5, name


def test_double_on_every_isa_equals_the_reference(isa: str, scene: Scene) -> None:
    for x, y in zip(slopes(scene), slopes(scene, function=reference.project), strict=True):
        assert relative_error(x, y) < 1e-9


def test_threads_do_not_matter(set_threads: Callable[[int], None]) -> None:
    scene = random_scene(n=5000).to(torch.float32)
    found = []
    for n in (1, 2, 8):
        set_threads(n)
        p = splats(scene)
        found.append([p.radii, *(getattr(p, name) for name in OUTPUTS), *slopes(scene)])
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_many_cameras_equal_one_at_a_time(scene: Scene) -> None:
    together = splats(scene)
    for v in range(2):
        alone = splats(scene.view(v))
        for name in (*OUTPUTS, "radii"):
            assert torch.equal(getattr(alone, name)[0], getattr(together, name)[v])


def test_no_gaussians() -> None:
    empty = random_scene(n=0)
    p = splats(empty)
    assert p.means2d.shape == (2, 0, 2)
    assert p.radii.dtype == torch.int32
    assert [x.shape for x in slopes(empty)] == [(0, 3), (0, 4), (0, 3), (2, 4, 4), (2, 3, 3)]
    assert not any(x.any() for x in slopes(empty)[3:])


def test_strided_inputs_equal_contiguous_ones(scene: Scene) -> None:
    def spread(x: Tensor) -> Tensor:
        wide = torch.zeros(*x.shape[:-1], 2 * x.shape[-1], dtype=x.dtype)
        wide[..., ::2] = x
        return wide[..., ::2]

    strided = scene.map(spread)
    assert not strided.means.is_contiguous()
    assert torch.equal(splats(strided).factors, splats(scene).factors)
    assert torch.equal(slopes(strided)[0], slopes(scene)[0])


@pytest.mark.parametrize("name", ["cam_from_world", "intrinsics"])
def test_gradient_of_one_part_of_the_camera(name: str, scene: Scene) -> None:
    """Who optimises poses or lenses alone gets the same numbers."""
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


def test_splats_beside_the_image_are_culled() -> None:
    scene = front(4)
    radius = float(splats(scene).radii[0, 0, 0])
    per_px = 3 / scene.intrinsics[0, 0, 0]
    edge = 16 + radius
    scene.means[:, 0] = torch.tensor([-edge - 0.01, -edge + 0.01, edge - 0.01, edge]) * per_px
    assert visible(splats(scene))[0].tolist() == [False, True, True, False]


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


def test_quaternions_need_not_be_normalised(scene: Scene) -> None:
    longer = replace(scene, quats=7 * scene.quats)
    torch.testing.assert_close(
        splats(longer).factors, splats(scene).factors, rtol=1e-12, atol=1e-14
    )
    torch.testing.assert_close(7 * slopes(longer)[1], slopes(scene)[1], rtol=1e-9, atol=1e-12)
    along = (slopes(scene)[1] * scene.quats).sum(-1)
    assert along.abs().max() < 1e-12 * slopes(scene)[1].abs().max()  # length has no influence


def test_world_and_camera_moved_together_see_the_same(scene: Scene) -> None:
    motion = look_around(3)[2]
    # 0.6 rad about y
    turn = torch.tensor([0.955336489125606, 0.0, 0.29552020666133955, 0.0], dtype=torch.float64)
    w, (x, y, z, s) = turn, scene.quats.unbind(-1)
    product = [w[0] * x - w[2] * z, w[0] * y + w[2] * s, w[0] * z + w[2] * x, w[0] * s - w[2] * y]
    moved = replace(
        scene,
        means=scene.means @ motion[:3, :3].T + motion[:3, 3],
        quats=torch.stack(product, -1),
        cam_from_world=scene.cam_from_world @ torch.linalg.inv(motion),
    )
    ours = splats(moved)
    truth = splats(scene)
    for name in OUTPUTS:
        assert relative_error(getattr(ours, name), getattr(truth, name)) < 1e-12, name


@pytest.mark.parametrize("with_cameras", [False, True])
def test_opcheck(with_cameras: bool, scene: Scene) -> None:
    leaves = scene.leaves()
    cameras = leaves if with_cameras else scene
    tensors = (
        leaves.means,
        leaves.quats,
        leaves.scales,
        scene.opacities,
        cameras.cam_from_world,
        cameras.intrinsics,
    )
    args = (*tensors, list(scene.size), [0.3, 0.2, 1e10, 0.0, 0.0], False)
    torch.library.opcheck(project_op, args)


def test_opcheck_backward(scene: Scene) -> None:
    p = splats(scene)
    tensors = [
        scene.means,
        scene.quats,
        scene.scales,
        scene.opacities,
        scene.cam_from_world,
        scene.intrinsics,
    ]
    grads = [weights(getattr(p, name)) for name in OUTPUTS]
    args = (tensors, p.radii, grads, list(scene.size), [0.3, 0.2, 1e10, 0.0, 0.0], False, True)
    torch.library.opcheck(project_backward_op, args)


def test_single_and_empty_batches_of_cameras(scene: Scene) -> None:
    none = Cameras(scene.cam_from_world[:0], scene.intrinsics[:0], *scene.size)
    p = project(scene.means, scene.quats, scene.scales, scene.opacities, none)
    assert p.means2d.shape == (0, 20, 2)
