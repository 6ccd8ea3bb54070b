"""``dyngs.rasterization``: the interface of gsplat 1.5, and agreement with gsplat's formulas where
it is installed."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from types import ModuleType
from typing import Any

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scenes import Scene, random_scene, relative_error, weights
from torch import Tensor

from dyngs.api.compat import rasterization
from dyngs.core.errors import DyngsError
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.ops.harmonics import evaluate_harmonics
from dyngs.ops.projection import Projection, ProjectionOptions, project
from dyngs.ops.rasterization import BlendOptions

pytestmark = pytest.mark.usefixtures("one_thread")

WHY = "gsplat is not installed (pip install --no-deps gsplat==1.5.3)"
GSPLAT_LIMITS = ProjectionOptions(near=0.01)
MODES = ["RGB", "D", "ED", "RGB+D", "RGB+ED"]


@pytest.fixture
def formulas() -> ModuleType:
    """gsplat's plain-torch reference; it runs on a CPU."""
    pytest.importorskip("gsplat", reason=WHY)
    return pytest.importorskip("gsplat.cuda._torch_impl", reason=WHY)


def call(scene: Scene, **options: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """``rasterization`` of the scene with positional arguments as gsplat orders them."""
    colors = options.pop("colors", scene.sh[:, 0].abs())
    return rasterization(
        scene.means,
        scene.quats,
        scene.scales,
        scene.opacities,
        colors,
        scene.cam_from_world,
        scene.intrinsics,
        scene.width,
        scene.height,
        **options,
    )


def near_scene() -> Scene:
    """Some Gaussians close to the camera and some beside the image, so that the clamp of the
    Jacobian matters."""
    scene = random_scene(n=60, views=3, seed=8, degree=3)
    return replace(scene, means=2 * scene.means)


# --- against gsplat's reference
# ---------------------------------------------------------------------------------------


def gsplat_projection(formulas: ModuleType, scene: Scene) -> tuple[Tensor, ...]:
    covariances, _ = formulas._quat_scale_to_covar_preci(scene.quats, scene.scales, True, False)
    return formulas._fully_fused_projection(
        scene.means,
        covariances,
        scene.cam_from_world,
        scene.intrinsics,
        scene.width,
        scene.height,
        calc_compensations=True,
    )


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-5)])
def test_projection_equals_gsplat(
    formulas: ModuleType, dtype: torch.dtype, tolerance: float
) -> None:
    """Float32 to 1e-5 of the largest value: both round, gsplat's determinant cancels for thin
    splats."""
    scene = near_scene().to(dtype)
    radii, means2d, depths, conics, compensations = gsplat_projection(
        formulas, scene.to(torch.float64)
    )
    ours = project(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.cameras, GSPLAT_LIMITS
    )
    seen = ours.radii[..., 0] > 0
    assert seen.any()
    assert (radii > 0).all(-1)[seen].all()  # ours cull tighter: by the opacity
    assert relative_error(ours.means2d[seen], means2d[seen]) < tolerance
    assert relative_error(ours.depths[seen], depths[seen]) < tolerance
    assert relative_error(ours.conics[seen], conics[seen]) < tolerance
    assert relative_error(ours.compensations[seen], compensations[seen]) < tolerance


def test_projection_gradients_equal_gsplat(formulas: ModuleType) -> None:
    scene = near_scene()
    names = ("means", "quats", "scales", "cam_from_world")

    def outputs_of_ours(s: Scene) -> list[Tensor]:
        p = project(s.means, s.quats, s.scales, s.opacities, s.cameras, GSPLAT_LIMITS)
        return [p.means2d, p.depths, p.conics, p.compensations]

    def outputs_of_gsplat(s: Scene) -> list[Tensor]:
        return list(gsplat_projection(formulas, s)[1:])

    seen = project(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.cameras, GSPLAT_LIMITS
    ).radii[..., 0]

    def slopes(outputs: Callable[[Scene], list[Tensor]]) -> tuple[Tensor, ...]:
        leaves = scene.leaves()
        parts = [(x[seen > 0] * weights(x)[seen > 0]).sum() for x in outputs(leaves)]
        return torch.autograd.grad(
            torch.stack(parts).sum(), [getattr(leaves, name) for name in names]
        )

    for name, x, y in zip(names, slopes(outputs_of_ours), slopes(outputs_of_gsplat), strict=True):
        assert relative_error(x, y) < 1e-9, name


def test_radii_follow_gsplats_rule(formulas: ModuleType) -> None:
    """ceil(extend * sigma) with extend = min(3.33, sqrt(2 ln(255 o))), as its kernels do."""
    scene = near_scene()
    reference_radii, _, _, conics, _ = gsplat_projection(formulas, scene)
    a, b, c = conics.unbind(-1)
    sigma = torch.stack([c, a], -1) / (a * c - b * b)[..., None]
    extend = (2 * (255 * scene.opacities).log()).sqrt().clamp_max(3.33)
    ours = project(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.cameras, GSPLAT_LIMITS
    ).radii
    seen = (ours > 0).all(-1)
    expected = (extend[None, :, None] * sigma.sqrt()).ceil().int()
    assert torch.equal(ours[seen], expected[seen])
    # its plain-torch version ignores the opacity
    assert (ours[seen] <= reference_radii[seen]).all()


@pytest.mark.parametrize("degree", range(5))
def test_harmonics_equal_gsplat(formulas: ModuleType, degree: int) -> None:
    scene = random_scene(n=40, views=2, degree=degree)
    centers = scene.cameras.centers
    directions = scene.means[None] - centers[:, None]
    theirs = formulas._spherical_harmonics(degree, directions, scene.sh.expand(2, *scene.sh.shape))
    visible = torch.ones(2, 40, 2, dtype=torch.int32)
    ours = evaluate_harmonics(scene.means, centers, scene.sh, visible, degree)
    torch.testing.assert_close(ours, (theirs + 0.5).clamp_min(0), rtol=1e-9, atol=1e-12)


def test_parameters_are_those_of_gsplat() -> None:
    gsplat = pytest.importorskip("gsplat", reason=WHY)
    theirs = inspect.signature(gsplat.rasterization).parameters
    ours = inspect.signature(rasterization).parameters
    assert list(ours) == list(theirs)
    defaults = {
        name: (p.default, theirs[name].default)
        for name, p in ours.items()
        if name != "rolling_shutter"
    }
    assert {name: pair for name, pair in defaults.items() if pair[0] != pair[1]} == {}
    call(random_scene(), rolling_shutter=theirs["rolling_shutter"].default)


# --- the interface
# ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("render_mode", MODES)
def test_equals_render(render_mode: str, rasterize_mode: str, packed: bool) -> None:
    """With gsplat's near plane and largest alpha."""
    scene = near_scene()
    depth = {"D": "accumulated", "ED": "expected"}.get(render_mode.rpartition("+")[2], "none")
    options = RenderOptions(near=0.01, alpha_max=0.999, mode=rasterize_mode, depth=depth)
    truth = render(scene.gaussians, scene.cameras, options, background=scene.background)
    image, alpha, _ = call(
        scene,
        colors=scene.sh,
        sh_degree=3,
        backgrounds=scene.background,
        render_mode=render_mode,
        rasterize_mode=rasterize_mode,
        packed=packed,
    )
    parts = [truth.rgb] if "RGB" in render_mode else []
    parts += [truth.depth[..., None]] if truth.depth is not None else []
    # 1e-9, not bitwise: render() gets scales and opacities through log and logit
    torch.testing.assert_close(image, torch.cat(parts, -1), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(alpha, truth.alpha[..., None], rtol=1e-9, atol=1e-9)


def test_meta_unpacked() -> None:
    scene = near_scene()
    _, _, meta = call(scene, packed=False, rasterize_mode="antialiased")
    limits = replace(GSPLAT_LIMITS, antialiased=True)
    p = project(scene.means, scene.quats, scene.scales, scene.opacities, scene.cameras, limits)
    for name in ("means2d", "depths", "conics", "radii"):
        assert torch.equal(meta[name], getattr(p, name)), name
    assert torch.equal(meta["opacities"], scene.opacities * p.compensations)
    sizes = {
        "width": 37,
        "height": 29,
        "tile_size": 16,
        "tile_width": 3,
        "tile_height": 2,
        "n_cameras": 3,
    }
    assert {name: meta[name] for name in sizes} == sizes
    assert meta["camera_ids"] is None
    assert meta["gaussian_ids"] is None


def test_meta_packed_lists_the_visible_pairs() -> None:
    scene = near_scene()
    _, _, packed = call(scene)
    _, _, dense = call(scene, packed=False)
    pairs = packed["camera_ids"], packed["gaussian_ids"]
    assert torch.equal((dense["radii"] > 0).all(-1).nonzero(), torch.stack(pairs, 1))
    for name in ("means2d", "depths", "conics", "radii", "opacities", "tiles_per_gauss"):
        assert torch.equal(packed[name], dense[name][pairs]), name


@pytest.mark.parametrize("packed", [True, False])
def test_tile_lists_are_sorted_by_depth_and_complete(packed: bool) -> None:
    _, _, meta = call(near_scene(), packed=packed)
    depths = meta["depths"].reshape(-1)
    ids = meta["flatten_ids"].long()
    assert meta["isect_offsets"].shape == (3, 2, 3)
    bounds = [*meta["isect_offsets"].flatten().tolist(), len(ids)]
    for begin, end in pairwise(bounds):
        assert (depths[ids[begin:end]].diff() >= 0).all()
    counts = torch.bincount(ids, minlength=len(depths))
    assert torch.equal(counts, meta["tiles_per_gauss"].reshape(-1).long())


@pytest.mark.parametrize("packed", [True, False])
def test_means2d_keeps_its_gradient(packed: bool) -> None:
    """What gsplat's densification reads; signed and absolute parts are those of the probe."""
    scene = near_scene()
    means = scene.means.requires_grad_()
    image, _, meta = call(replace(scene, means=means), packed=packed, absgrad=True)
    meta["means2d"].retain_grad()
    (image * weights(image)).sum().backward()
    probe = torch.zeros(3, 60, 4, dtype=torch.float64, requires_grad=True)
    p = project(
        means.detach(), scene.quats, scene.scales, scene.opacities, scene.cameras, GSPLAT_LIMITS
    )
    again = rasterize_with_probe(scene, p, probe)
    (again * weights(again)).sum().backward()
    assert probe.grad is not None
    truth = probe.grad if not packed else probe.grad[meta["camera_ids"], meta["gaussian_ids"]]
    torch.testing.assert_close(meta["means2d"].grad, truth[..., :2], rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(meta["means2d"].absgrad, truth[..., 2:], rtol=1e-12, atol=1e-14)
    assert means.grad is not None
    assert means.grad.any()


def rasterize_with_probe(scene: Scene, projection: Projection, probe: Tensor) -> Tensor:
    from dyngs.ops.rasterization import rasterize

    colors = scene.sh[:, 0].abs().expand(3, 60, 3)
    options = BlendOptions(alpha_max=0.999, absgrad=True)
    opacities = scene.opacities.expand(3, 60)
    return rasterize(projection, opacities, colors, scene.size, probe=probe, options=options).color


UNSUPPORTED: dict[str, Any] = {
    "tile_size": 8,
    "sparse_grad": True,
    "distributed": True,
    "camera_model": "fisheye",
    "segmented": True,
    "covars": torch.eye(3).expand(20, 3, 3),
    "with_ut": True,
    "with_eval3d": True,
    "radial_coeffs": torch.zeros(2, 6),
    "tangential_coeffs": torch.zeros(2, 2),
    "thin_prism_coeffs": torch.zeros(2, 4),
    "ftheta_coeffs": object(),
    "rolling_shutter": "ROLLING_TOP_TO_BOTTOM",
    "viewmats_rs": torch.eye(4).expand(2, 4, 4),
}


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_unsupported_arguments_are_refused_by_name(name: str, scene: Scene) -> None:
    with pytest.raises(DyngsError, match=rf"does not support {name} "):
        call(scene, **{name: UNSUPPORTED[name]})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"render_mode": "rgb"}, "render_mode must be one of RGB, D, ED, .*got 'rgb'"),
        (
            {"rasterize_mode": "mip"},
            "rasterize_mode must be one of classic, antialiased, got 'mip'",
        ),
        ({"sh_degree": 3}, "colors must be"),
        (
            {"colors": torch.zeros(7, 3).double()},
            r"colors must be .* 20, D\), got \(7, 3\)",
        ),
        (
            {"colors": torch.zeros(20, 4, 3).double(), "sh_degree": 2},
            "sh_degree 2 does not fit 4 coefficients",
        ),
    ],
)
def test_what_does_not_fit_is_named(options: dict[str, Any], message: str, scene: Scene) -> None:
    with pytest.raises(DyngsError, match=message):
        call(scene, **options)


NUMBERS: dict[str, list[Any]] = {
    "near_plane": [-1e-3, math.nan, math.inf, -math.inf, "0.1", None],
    "far_plane": [-1.0, 0.0, 0.01, math.nan, -math.inf, None],
    "radius_clip": [-1.0, math.nan, math.inf],
    "eps2d": [-0.1, math.nan, math.inf, -math.inf, 1e39, None],
    "channel_chunk": [0, -1, 2.5, None],
    "width": [0, -1, 2.5, math.nan, "37", 2**31, True],
    "height": [0, -1, 2.5, None],
    "sh_degree": [-1, 5, 1.5, "2"],
}


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name, values in NUMBERS.items() for value in values]
)
def test_numbers_out_of_range_are_refused_by_name(name: str, value: Any) -> None:
    """Some gave an empty image, some a mirrored one, some an error of another library."""
    scene = random_scene(degree=3)
    said = {"near_plane": "near", "far_plane": "far"}.get(name, name)
    sizes = {"width": scene.width, "height": scene.height} | (
        {name: value} if name in ("width", "height") else {}
    )
    options = {} if name in sizes else {name: value}
    with pytest.raises(DyngsError, match=f"^rasterization: (?s:.*){said}"):
        call(
            replace(scene, **sizes),
            **({"colors": scene.sh} | options if name == "sh_degree" else options),
        )


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    "name", ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds"]
)
def test_what_is_not_finite_is_named(name: str, bad: float, scene: Scene) -> None:
    fields = {"viewmats": "cam_from_world", "Ks": "intrinsics"}
    options = {"colors": scene.sh[:, 0].abs(), "backgrounds": scene.background}
    x = (options[name] if name in options else getattr(scene, fields.get(name, name))).clone()
    x.view(-1)[0] = bad
    changed = {} if name in options else {fields.get(name, name): x}
    options |= {name: x} if name in options else {}
    with pytest.raises(DyngsError, match=f"^{name} holds 1 NaN or infinite"):
        call(replace(scene, **changed), **options)


EXTREMES: dict[str, list[float]] = {
    "near_plane": [0.0, 1e-45, 1e-3, 3.0, 1e30, 3.4e38],
    "far_plane": [1e-44, 5.0, 1e10, 3.4e38, 1e300, math.inf],
    "radius_clip": [0.0, 1e-30, 5.0, 1e30],
    "eps2d": [0.0, 1e-45, 1e-30, 0.3, 1e10, 1e30, 3.4e38],
}


@settings(max_examples=40, deadline=None)
@example(  # gradients of NaN, from a focal length that is refused now
    {"near_plane": 0.0, "far_plane": 5.0, "radius_clip": 0.0, "eps2d": 1e-45},
    1e-45,
    torch.float32,
    "classic",
    "RGB",
)
@given(
    st.fixed_dictionaries({name: st.sampled_from(values) for name, values in EXTREMES.items()}),
    st.sampled_from([1e-45, 1e-30, 1e-7, 1e-3, 1.0, 1e3, 1e10, 1e15, 1e30, 3e38]),
    st.sampled_from([torch.float32, torch.float64]),
    st.sampled_from(["classic", "antialiased"]),
    st.sampled_from(["RGB", "RGB+ED", "D"]),
)
def test_extreme_numbers_give_finite_images_or_one_line(
    limits: dict[str, float],
    focal: float,
    dtype: torch.dtype,
    rasterize_mode: str,
    render_mode: str,
) -> None:
    scene = random_scene(n=8, views=1).to(dtype)
    intrinsics = scene.intrinsics.clone()
    intrinsics[:, 0, 0] *= focal
    scene = replace(scene, intrinsics=intrinsics)
    leaves = scene.leaves()
    try:
        image, alpha, _ = call(
            leaves, rasterize_mode=rasterize_mode, render_mode=render_mode, **limits
        )
    except DyngsError:
        assert (
            limits["far_plane"] <= limits["near_plane"]
            or not 1e-6 <= float(intrinsics[0, 0, 0]) <= 1e12
        )
        return
    assert bool(image.isfinite().all())
    assert 0 <= float(alpha.detach().min()) <= float(alpha.detach().max()) <= 1
    image.sum().backward()
    for name in ("means", "quats", "scales", "opacities"):
        grad = getattr(leaves, name).grad
        assert grad is None or bool(grad.isfinite().all()), name
