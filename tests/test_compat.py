"""``dyngs.rasterization``: the interface of gsplat 1.5."""

from __future__ import annotations

import inspect
import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scenes import Scene, random_scene, weights
from torch import Tensor

from dyngs.compat.rendering import rasterization
from dyngs.core.errors import DyngsError
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.ops.projection import Projection, ProjectionOptions, project
from dyngs.ops.rasterization import BlendOptions

pytestmark = pytest.mark.usefixtures("one_thread")

GSPLAT_LIMITS = ProjectionOptions(near=0.01)
MODES = ["RGB", "D", "ED", "RGB+D", "RGB+ED"]


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


def test_parameters_are_those_of_gsplat() -> None:
    """Of gsplat 1.5.3, in its order."""
    assert " ".join(inspect.signature(rasterization).parameters) == (
        "means quats scales opacities colors viewmats Ks width height near_plane far_plane "
        "radius_clip eps2d sh_degree packed tile_size backgrounds render_mode sparse_grad absgrad "
        "rasterize_mode channel_chunk distributed camera_model segmented covars with_ut "
        "with_eval3d radial_coeffs tangential_coeffs thin_prism_coeffs "
        "ftheta_coeffs rolling_shutter viewmats_rs"
    )


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
    """gsplat's densification reads this gradient; signed and absolute parts match the probe."""
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
def test_mismatched_arguments_are_named(
    options: dict[str, Any], message: str, scene: Scene
) -> None:
    with pytest.raises(DyngsError, match=message):
        call(scene, **options)


NUMBERS: dict[str, list[Any]] = {
    "near_plane": [-1e-3, math.nan, math.inf, -math.inf, "0.1", None],
    "far_plane": [-1.0, 0.0, math.nan, -math.inf, None],
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
def test_non_finite_arguments_are_named(name: str, bad: float, scene: Scene) -> None:
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
