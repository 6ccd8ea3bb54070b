"""``rasterization`` with the interface of gsplat 1.5, so that its users can switch by changing an
import.

Names, shapes, defaults and conventions follow gsplat's documentation; the implementation is ours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import MAX_SH_DEGREE
from dyngs.core.errors import DyngsError
from dyngs.models.renderable import check_focal_lengths, check_poses
from dyngs.ops.harmonics import evaluate_harmonics
from dyngs.ops.projection import Projection, ProjectionOptions, project
from dyngs.ops.rasterization import (
    MAX_CHANNELS,
    TILE,
    BlendOptions,
    TileEntries,
    bin_tiles,
    rasterize,
)
from dyngs.ops.registration import (
    LARGEST_COUNT,
    check_choice,
    check_count,
    check_finite,
    check_tensors,
)

GSPLAT_ALPHA_MAX = 0.999
"""Largest alpha of gsplat 1.5 (dyngs and 3DGS: 0.99)."""

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: Literal["pinhole", "ortho", "fisheye", "ftheta"] = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Return images (C, H, W, D), their alphas (C, H, W, 1), and a dict of intermediate results.

    Differentiable in means, quats, scales, opacities, colors, viewmats and backgrounds.
    ``meta["means2d"]`` may be asked to ``retain_grad()``; with ``absgrad`` it also gets an
    attribute ``absgrad`` in the backward pass.

    Example:

        import torch

        import dyngs

        means = torch.tensor([[0.0, 0, 4]])
        quats = torch.tensor([[1.0, 0, 0, 0]])
        scales = torch.full((1, 3), 0.3)
        opacities = torch.tensor([0.9])
        colors = torch.tensor([[1.0, 0.5, 0]])
        pose = torch.eye(4)[None]
        intrinsics = torch.tensor([[[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]])
        images, alphas, meta = dyngs.rasterization(
            means, quats, scales, opacities, colors, pose, intrinsics, 64, 48
        )

    Args:
        means: (N, 3) world.
        quats: (N, 4) wxyz, any norm.
        scales: (N, 3) standard deviations.
        opacities: (N,) in [0, 1].
        colors: (N, D) or (C, N, D) values; with ``sh_degree``, (N, K, 3) or (C, N, K, 3)
            coefficients.
        viewmats: (C, 4, 4) world to camera, OpenCV axes; rigid, the last row is not read.
        Ks: (C, 3, 3) intrinsics, px; focal lengths positive, skew and the last row are not read.
        width: px.
        height: px.
        near_plane: smallest depth of the centres in view space.
        far_plane: largest depth of the centres in view space; may be infinite.
        radius_clip: splats with no larger half extent are skipped, px.
        eps2d: 2D low-pass variance, px^2.
        sh_degree: degree to use; None if colors are values.
        packed: ``meta`` lists the visible (camera, Gaussian) pairs instead of (C, N) arrays. Images
            are the same.
        backgrounds: (C, D).
        render_mode: colour, accumulated depth (D), expected depth (ED), or both; depth is the last
            channel.
        absgrad: see above.
        rasterize_mode: ``antialiased`` compensates the opacity for the low-pass.
        channel_chunk: channels per pass; at most 40 are taken.

    Raises:
        DyngsError: shapes that do not fit, NaN or infinite input, numbers out of their range
            (planes in the wrong order, focal lengths or sizes that are not positive, ...), or an
            argument that dyngs does not support.
    """
    refused = {
        "tile_size": tile_size != TILE,
        "sparse_grad": sparse_grad,
        "distributed": distributed,
        "camera_model": camera_model != "pinhole",
        "segmented": segmented,
        "covars": covars is not None,
        "with_ut": with_ut,
        "with_eval3d": with_eval3d,
        "radial_coeffs": radial_coeffs is not None,
        "tangential_coeffs": tangential_coeffs is not None,
        "thin_prism_coeffs": thin_prism_coeffs is not None,
        "ftheta_coeffs": ftheta_coeffs is not None,
        "rolling_shutter": getattr(rolling_shutter, "name", rolling_shutter)
        not in (None, "GLOBAL"),
        "viewmats_rs": viewmats_rs is not None,
    }
    if any(refused.values()):
        names = ", ".join(name for name, used in refused.items() if used)
        raise DyngsError(f"rasterization: dyngs does not support {names} with the value given")
    for name, count in (("width", width), ("height", height), ("channel_chunk", channel_chunk)):
        check_count(f"rasterization: {name}", count, 1, LARGEST_COUNT)
    check_choice("rasterization: render_mode", render_mode, ("RGB", "D", "ED", "RGB+D", "RGB+ED"))
    check_choice("rasterization: rasterize_mode", rasterize_mode, ("classic", "antialiased"))
    try:
        limits = ProjectionOptions(
            eps2d, near_plane, far_plane, 1 / 255, radius_clip, rasterize_mode == "antialiased"
        )
    except DyngsError as error:
        raise DyngsError(f"rasterization: {error}") from None
    tensors = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities,
        "colors": colors,
    }
    tensors |= {"viewmats": viewmats, "Ks": Ks} | (
        {} if backgrounds is None else {"backgrounds": backgrounds}
    )
    _check_tensors(tensors, sh_degree, with_colors="RGB" in render_mode)
    check_finite(tensors)
    check_focal_lengths(Ks, "Ks")
    check_poses(viewmats, "viewmats")
    cameras = Cameras(viewmats, Ks, width, height)
    splats = _project(means, quats, scales, opacities, cameras, limits, packed=packed)
    shades = _colors(means, cameras, colors, splats.projection, sh_degree)
    channels, backgrounds = _with_depth(shades, splats.projection.depths, backgrounds, render_mode)
    options = BlendOptions(alpha_max=GSPLAT_ALPHA_MAX, absgrad=absgrad)
    entries = bin_tiles(splats.projection, splats.opacities, (width, height), options)
    image, alpha = _blend(
        splats, channels, entries, backgrounds, (width, height), options, channel_chunk
    )
    if render_mode in ("ED", "RGB+ED"):
        expected = image[..., -1:] / alpha.clamp(min=1e-10)
        image = torch.cat([image[..., :-1], expected], dim=-1)
    return image, alpha, _meta(splats, entries, cameras)


@dataclass(frozen=True)
class _Splats:
    """Projected Gaussians: ``projection`` is dense (C, N); ``means2d`` is the tensor that the user
    gets to see."""

    projection: Projection
    opacities: Tensor
    means2d: Tensor
    camera_ids: Tensor | None
    gaussian_ids: Tensor | None

    def seen(self, x: Tensor) -> Tensor:
        """Return ``x`` (C, N, ...) as ``meta`` shows it: dense, or one row per visible pair."""
        return x if self.camera_ids is None else x[self.camera_ids, self.gaussian_ids]


def _check_tensors(tensors: dict[str, Tensor], sh_degree: int | None, *, with_colors: bool) -> None:
    """Raise an error unless the tensors fit each other."""
    op = "rasterization"
    for name, x in tensors.items():
        if not isinstance(x, Tensor):
            raise DyngsError(f"{op}: {name} must be a torch tensor, got {type(x).__name__}")
    means = tensors["means"]
    colors = tensors["colors"]
    if means.ndim != 2 or means.dtype not in (torch.float32, torch.float64):
        got = f"{tuple(means.shape)} {means.dtype}"
        raise DyngsError(f"{op}: means must be (N, 3) float32 (or float64 for checks), got {got}")
    n = len(means)
    c = tensors["viewmats"].shape[0] if tensors["viewmats"].ndim else 0
    shapes: dict[str, tuple[int, ...]] = {
        "means": (n, 3),
        "quats": (n, 4),
        "scales": (n, 3),
        "opacities": (n,),
        "viewmats": (c, 4, 4),
        "Ks": (c, 3, 3),
    }
    if with_colors:  # to depth alone the background does not matter
        shapes["backgrounds"] = (c, *((3,) if sh_degree is not None else colors.shape[-1:]))
    given = {name: (x, shapes.get(name, tuple(x.shape))) for name, x in tensors.items()}
    check_tensors(op, given, means.dtype)
    values = 1 if sh_degree is None else 2
    per_gaussian = tuple(colors.shape[:-values]) in ((n,), (c, n))
    if not per_gaussian or (colors.shape[-1] == 0 if sh_degree is None else colors.shape[-1] != 3):
        wanted = "D" if sh_degree is None else "K, 3"
        got = tuple(colors.shape)
        raise DyngsError(f"{op}: colors must be ([{c},] {n}, {wanted}), got {got}")
    if sh_degree is not None:
        check_count(f"{op}: sh_degree", sh_degree, 0, MAX_SH_DEGREE)
        if (sh_degree + 1) ** 2 > colors.shape[-2]:
            count = colors.shape[-2]
            raise DyngsError(f"{op}: sh_degree {sh_degree} does not fit {count} coefficients")


def _project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    cameras: Cameras,
    limits: ProjectionOptions,
    *,
    packed: bool,
) -> _Splats:
    projection = project(means, quats, scales, opacities, cameras, limits)
    per_view = opacities.expand(len(cameras), -1)
    if limits.antialiased:
        per_view = per_view * projection.compensations
    if not packed:
        return _Splats(projection, per_view, projection.means2d, None, None)
    # The user may ask the packed tensor for its gradient, so the image has to depend on it.
    camera_ids, gaussian_ids = torch.nonzero((projection.radii > 0).all(-1), as_tuple=True)
    visible = projection.means2d[camera_ids, gaussian_ids]
    dense = torch.zeros_like(projection.means2d).index_put((camera_ids, gaussian_ids), visible)
    return _Splats(replace(projection, means2d=dense), per_view, visible, camera_ids, gaussian_ids)


def _colors(
    means: Tensor, cameras: Cameras, colors: Tensor, projection: Projection, sh_degree: int | None
) -> Tensor:
    """Return (C, N, D) colour values."""
    c, n = projection.depths.shape
    if sh_degree is None:
        return colors.expand(c, n, colors.shape[-1])
    if colors.ndim == 3:
        return evaluate_harmonics(means, cameras.centers, colors, projection.radii, sh_degree)
    each = [slice(i, i + 1) for i in range(c)]
    centers = cameras.centers
    radii = projection.radii
    return torch.cat(
        [evaluate_harmonics(means, centers[i], colors[i][0], radii[i], sh_degree) for i in each]
    )


def _with_depth(
    shades: Tensor, depths: Tensor, backgrounds: Tensor | None, render_mode: str
) -> tuple[Tensor, Tensor | None]:
    """Return the channels to blend and their backgrounds; depth comes last, on a background of
    0."""
    depth = depths[..., None]
    if render_mode in ("D", "ED"):
        return depth, None
    if render_mode == "RGB":
        return shades, backgrounds
    if backgrounds is not None:
        backgrounds = torch.cat([backgrounds, torch.zeros_like(backgrounds[:, :1])], dim=-1)
    return torch.cat([shades, depth], dim=-1), backgrounds


def _blend(
    splats: _Splats,
    channels: Tensor,
    entries: TileEntries,
    backgrounds: Tensor | None,
    size: tuple[int, int],
    options: BlendOptions,
    channel_chunk: int,
) -> tuple[Tensor, Tensor]:
    """Return image (C, H, W, D) and alpha (C, H, W, 1), drawn in passes of ``channel_chunk``
    channels."""
    chunk = min(channel_chunk, MAX_CHANNELS)
    probe = _absgrad_probe(splats) if options.absgrad else None
    images = []
    transmittance = None
    for start in range(0, channels.shape[-1], chunk):
        part = slice(start, start + chunk)
        background = None if backgrounds is None else backgrounds[:, part]
        blended = rasterize(
            splats.projection,
            splats.opacities,
            channels[..., part],
            size,
            background=background,
            probe=probe,
            options=options,
            entries=entries,
        )
        images.append(blended.color)
        transmittance = blended.transmittance if transmittance is None else transmittance
    assert transmittance is not None  # D >= 1
    return torch.cat(images, dim=-1), (1 - transmittance)[..., None]


def _absgrad_probe(splats: _Splats) -> Tensor:
    """Return a probe whose gradient is handed to ``means2d.absgrad`` in the backward pass, as
    gsplat does."""
    probe = splats.projection.means2d.new_zeros(
        *splats.projection.depths.shape, 4, requires_grad=True
    )
    means2d = splats.means2d

    def hand_over(grad: Tensor) -> None:
        means2d.absgrad = splats.seen(grad[..., 2:])  # type: ignore[attr-defined]

    probe.register_hook(hand_over)
    return probe


def _meta(splats: _Splats, entries: TileEntries, cameras: Cameras) -> dict[str, Any]:
    projection = splats.projection
    columns = -(-cameras.width // TILE)
    rows = -(-cameras.height // TILE)
    flat_ids = entries.gaussians.long()
    if splats.camera_ids is not None:
        visible = (projection.radii > 0).all(-1).reshape(-1)
        flat_ids = (torch.cumsum(visible, 0) - 1)[flat_ids]
    return {
        "batch_ids": None if splats.camera_ids is None else torch.zeros_like(splats.camera_ids),
        "camera_ids": splats.camera_ids,
        "gaussian_ids": splats.gaussian_ids,
        "radii": splats.seen(projection.radii),
        "means2d": splats.means2d,
        "depths": splats.seen(projection.depths),
        "conics": splats.seen(projection.conics),
        "opacities": splats.seen(splats.opacities),
        "tile_width": columns,
        "tile_height": rows,
        "tiles_per_gauss": splats.seen(entries.tiles_per_gaussian.view(projection.depths.shape)),
        "flatten_ids": flat_ids.int(),
        "isect_offsets": entries.tile_offsets[:-1].view(len(cameras), rows, columns).int(),
        "width": cameras.width,
        "height": cameras.height,
        "tile_size": TILE,
        "n_batches": 1,
        "n_cameras": len(cameras),
    }
