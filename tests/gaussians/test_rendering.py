"""``render``: equality with the single ops, its options, and torch.compile."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from scenes import REFERENCE, Limits, Scene, draw, look_around, random_scene, weights
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0, RasterizeMode
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, contributions, render, sensitivities
from dyngs.models.renderable import Rendering
from dyngs.ops.projection import ProjectionOptions
from dyngs.ops.rasterization import BlendOptions

pytestmark = pytest.mark.usefixtures("one_thread")


def leaves(gaussians: Gaussians) -> Gaussians:
    return Gaussians(
        **{name: x.detach().clone().requires_grad_() for name, x in gaussians.tensors().items()}
    )


def half_transparent_wall(z: float = 4.0) -> tuple[Gaussians, Scene]:
    """One Gaussian so wide that alpha is 0.5 in every pixel, at depth z."""
    scene = random_scene(n=1, views=1, degree=0)
    gaussians = replace(
        scene.gaussians,
        means=torch.tensor([[0.0, 0.0, z]], dtype=torch.float64),
        log_scales=torch.full((1, 3), 20.0, dtype=torch.float64),
        logit_opacities=torch.zeros(1, dtype=torch.float64),
    )
    return gaussians, replace(scene, cam_from_world=torch.eye(4, dtype=torch.float64)[None])


@pytest.mark.parametrize("mode", RasterizeMode)
def test_render_equals_project_harmonics_rasterize(mode: RasterizeMode) -> None:
    scene = random_scene(degree=2)
    antialiased = mode == RasterizeMode.ANTIALIASED
    limits = Limits(ProjectionOptions(eps2d=0.1, near=2.5, antialiased=antialiased), BlendOptions())
    truth = draw(scene, REFERENCE, limits)
    options = RenderOptions(near=2.5, eps2d=0.1, mode=mode)
    ours = render(scene.gaussians, scene.cameras, options, background=scene.background)
    torch.testing.assert_close(ours.rgb, truth.blended.color, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(ours.alpha, 1 - truth.blended.transmittance, rtol=1e-9, atol=1e-12)
    assert ours.depth is None
    assert torch.equal(ours.radii, truth.projection.radii)


def test_a_shader_gives_the_colours() -> None:
    """The shader replaces SH, gets the visible Gaussians and cameras, and is differentiable."""
    scene = random_scene(degree=1)
    gaussians = leaves(scene.gaussians)
    asked = []

    def shader(drawn: Gaussians, cameras: Cameras, radii: Tensor) -> Tensor:
        asked.append((len(drawn), len(cameras), radii.shape))
        return drawn.base_rgb.clamp_min(0).expand(len(cameras), -1, -1)

    ours = render(gaussians, scene.cameras, shader=shader).rgb
    plain = render(leaves(scene.gaussians), scene.cameras, RenderOptions(sh_degree=0)).rgb
    torch.testing.assert_close(ours, plain, rtol=1e-12, atol=1e-12)
    assert asked == [(20, 2, (2, 20, 2))]
    ours.sum().backward()
    assert gaussians.sh.grad is not None
    assert gaussians.sh.grad[:, 0].any()
    assert not gaussians.sh.grad[:, 1:].any()


def test_depth_of_a_half_transparent_wall() -> None:
    gaussians, scene = half_transparent_wall(z=4.0)
    found = {}
    for kind in ("accumulated", "expected"):
        found[kind] = render(
            gaussians, scene.cameras, RenderOptions(depth=kind), background=torch.ones(3)
        ).depth
    torch.testing.assert_close(
        found["accumulated"], torch.full((1, 29, 37), 2.0).double(), rtol=1e-6, atol=0
    )
    torch.testing.assert_close(
        found["expected"], torch.full((1, 29, 37), 4.0).double(), rtol=1e-6, atol=0
    )


def test_depth_of_empty_pixels_is_zero_with_finite_gradient() -> None:
    scene = random_scene(n=1, views=1)
    scene.means[:] = torch.tensor([-0.9, -0.9, 0.0])
    gaussians = leaves(replace(scene, scales=0.1 * scene.scales).gaussians)
    image = render(gaussians, scene.cameras, RenderOptions(depth="expected"))
    assert image.depth is not None
    assert image.alpha[0, -1, -1] == image.depth[0, -1, -1] == 0
    image.depth.sum().backward()
    assert all(
        x.grad is not None and x.grad.isfinite().all()
        for x in gaussians.tensors().values()
        if x is not gaussians.sh
    )


@pytest.mark.parametrize("degree", range(4))
def test_sh_degree_limits_the_terms(degree: int) -> None:
    scene = random_scene(degree=3)
    cut = scene.gaussians.replace(sh=scene.sh[:, : (degree + 1) ** 2])
    limited = render(scene.gaussians, scene.cameras, RenderOptions(sh_degree=degree)).rgb
    assert torch.equal(limited, render(cut, scene.cameras).rgb)
    assert torch.equal(render(cut, scene.cameras, RenderOptions(sh_degree=4)).rgb, limited)


@pytest.mark.parametrize("shaded", [False, True])
def test_sensitivity_of_a_half_transparent_wall(shaded: bool) -> None:
    """dI/dG = o (c - B) with opacity 0.5, channels of 0.7 before a background of 0.3: (0.5 * 3 *
    0.4)^2 per pixel."""
    gaussians, scene = half_transparent_wall()
    color = torch.full((1, 1, 3), 0.7, dtype=torch.float64)
    if not shaded:
        gaussians = gaussians.replace(sh=(color - 0.5) / SH_C0)
    found = sensitivities(
        gaussians,
        scene.cameras,
        background=torch.full((3,), 0.3, dtype=torch.float64),
        shader=(lambda drawn, cameras, radii: color) if shaded else None,
    )
    pixels = scene.cameras.width * scene.cameras.height
    torch.testing.assert_close(
        found, torch.full((1, 1), 0.36 * pixels, dtype=torch.float64), rtol=1e-9, atol=0
    )


@pytest.mark.parametrize("mode", RasterizeMode)
def test_contributions_are_the_fractions_of_alpha(mode: RasterizeMode) -> None:
    scene = random_scene()
    options = RenderOptions(mode=mode)
    sums = contributions(scene.gaussians, scene.cameras, options)
    alpha = render(scene.gaussians, scene.cameras, options).alpha
    torch.testing.assert_close(sums.sum(1), alpha.sum((1, 2)), rtol=1e-12, atol=0)


def test_moving_world_and_camera_together_keeps_the_image() -> None:
    """Base colours only: harmonics would have to be turned, too."""
    scene = random_scene(degree=0)
    motion = look_around(3)[2]  # 0.6 rad about y and a translation
    c, s = 0.955336489125606, 0.29552020666133955
    w, x, y, z = scene.quats.unbind(-1)
    turned = torch.stack([c * w - s * y, c * x + s * z, c * y + s * w, c * z - s * x], -1)
    moved = replace(
        scene,
        means=scene.means @ motion[:3, :3].T + motion[:3, 3],
        quats=turned,
        cam_from_world=scene.cam_from_world @ torch.linalg.inv(motion),
    )
    ours = render(moved.gaussians, moved.cameras)
    truth = render(scene.gaussians, scene.cameras)
    torch.testing.assert_close(ours.rgb, truth.rgb, rtol=1e-9, atol=1e-11)


def compiled_and_plain(scene: Scene, options: RenderOptions) -> list[list[Tensor]]:
    """Image and gradients of ``render``, compiled and not."""

    def run(
        means: Tensor, quats: Tensor, log_scales: Tensor, logits: Tensor, sh: Tensor
    ) -> Rendering:
        gaussians = Gaussians(means, quats, log_scales, logits, sh)
        return render(gaussians, scene.cameras, options, background=scene.background)

    found = []
    for function in (torch.compile(run, fullgraph=True, backend="aot_eager"), run):
        inputs = list(leaves(scene.gaussians).tensors().values())
        image = function(*inputs)
        total = (image.rgb * weights(image.rgb)).sum() + image.alpha.sum()
        found.append([image.rgb, image.alpha, *torch.autograd.grad(total, inputs)])
    return found


def test_compiles_into_one_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    """The number of tile entries depends on the data: torch must be told to expect that. The check
    for NaN cannot be part of a graph (it may raise), hence ``trust``."""
    monkeypatch.setattr("torch._dynamo.config.capture_dynamic_output_shape_ops", True)
    scene = random_scene()
    compiled, plain = compiled_and_plain(
        scene, RenderOptions(nonfinite="trust", mode=RasterizeMode.ANTIALIASED)
    )
    for x, y in zip(compiled, plain, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-12, atol=1e-14)


VERBS = [render, contributions, sensitivities]


NO_ROTATIONS = {
    "mirrored": (torch.diag(torch.tensor([1.0, 1.0, -1.0])), "is mirrored"),
    "scaled": (2 * torch.eye(3), "differs from a rotation by 3"),
    "sheared": (
        torch.tensor([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        "differs from a rotation by 0.1",
    ),
    "zero": (torch.zeros(3, 3), "differs from a rotation by 1"),
}


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("fault", NO_ROTATIONS)
def test_non_rigid_poses_are_refused(verb: Callable[..., object], fault: str) -> None:
    scene = random_scene()
    matrix, reason = NO_ROTATIONS[fault]
    scene.cam_from_world[1, :3, :3] = matrix.to(scene.cam_from_world)
    with pytest.raises(
        DyngsError, match=rf"cam_from_world: the matrix of camera 1 {reason}"
    ) as caught:
        verb(scene.gaussians, scene.cameras)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("focal", [0.0, -20.0, 1e-7, 1e13])
def test_non_positive_focal_lengths_are_refused(verb: Callable[..., object], focal: float) -> None:
    scene = random_scene()
    scene.intrinsics[1, 1, 1] = focal
    with pytest.raises(
        DyngsError, match=r"intrinsics: focal lengths must be positive.*camera 1 has"
    ):
        verb(scene.gaussians, scene.cameras)


@pytest.mark.parametrize("verb", VERBS)
def test_nonfinite_input_is_named_by_every_function(verb: Callable[..., object]) -> None:
    scene = random_scene()
    scene.means[3, 1] = math.nan
    with pytest.raises(
        DyngsError, match=r"means holds 1 NaN or infinite value\(s\) in 1 of 20 rows"
    ):
        verb(scene.gaussians, scene.cameras)
    skipped = verb(scene.gaussians, scene.cameras, RenderOptions(nonfinite="skip"))
    found = skipped.rgb if isinstance(skipped, Rendering) else skipped
    assert isinstance(found, Tensor)
    assert found.isfinite().all()


@pytest.mark.parametrize("shape", [(2,), (4,), (3, 3), (1, 3), (2, 1), (2, 29, 37, 3), ()])
def test_background_and_probe_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    scene = random_scene()
    with pytest.raises(DyngsError, match=r"background must be \(3,\) or \(2, 3\), got"):
        render(scene.gaussians, scene.cameras, background=torch.zeros(shape))
    with pytest.raises(DyngsError, match=r"probe must be \(2, 20, 4\), got"):
        render(scene.gaussians, scene.cameras, probe=torch.zeros(shape))


@pytest.mark.parametrize("verb", VERBS)
def test_cameras_on_another_device_are_refused(verb: Callable[..., object]) -> None:
    scene = random_scene()
    with pytest.raises(
        DyngsError, match=r"the cameras are on meta, the Gaussians on cpu; move one of them"
    ):
        verb(scene.gaussians, scene.cameras.to(device="meta"))
