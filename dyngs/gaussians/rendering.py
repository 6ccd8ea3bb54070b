"""Rendering of Gaussians, and the contribution of each Gaussian to images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import MAX_SH_DEGREE, RasterizeMode
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.io.formats.splat_file import SplatFile
from dyngs.models.renderable import (
    DrawOptions,
    Rendering,
    check_background,
    check_views,
    near_plane,
)
from dyngs.ops.harmonics import evaluate_harmonics
from dyngs.ops.projection import Projection, ProjectionOptions, project
from dyngs.ops.rasterization import (
    BlendedImages,
    BlendOptions,
    Tally,
    blend_and_tally,
    rasterize,
    tally,
)
from dyngs.ops.registration import check_choice, check_count, check_finite, finite_rows

Shader = Callable[[Gaussians, Cameras, Tensor], Tensor]
"""Computes colours (V, N, 3) from Gaussians, cameras and radii (V, N, 2), instead of SH.

Gaussians with radius 0 are not drawn; their colours are ignored but must be finite.
"""


@dataclass(frozen=True)
class RenderOptions(DrawOptions):
    """Render options of Gaussians, in addition to those of ``DrawOptions``.

    Example:

        import dyngs

        sharp = dyngs.RenderOptions(eps2d=0.1, mode="antialiased", depth="expected")

    Attributes:
        far: Gaussians with a centre beyond are culled, world units.
        eps2d: 2D low-pass variance, px^2 (3DGS: 0.3; Mip-Splatting: 0.1).
        mode: classic, or antialiased (opacity compensated for the low-pass).
        sh_degree: highest degree used; None = that of the Gaussians.
        alpha_min, alpha_max, transmittance_min: see ``BlendOptions``.
        absgrad: fill the absolute part of the probe's gradient.
        nonfinite: NaN or infinite input raises (``error``), its Gaussians are skipped (``skip``),
            or the check is omitted (``trust``, for inputs known to be finite, as in training).

    Raises:
        DyngsError: a number out of range or NaN, or an unknown choice.
    """

    far: float = 1e10
    eps2d: float = 0.3
    mode: RasterizeMode = RasterizeMode.CLASSIC
    sh_degree: int | None = None
    alpha_min: float = 1 / 255
    alpha_max: float = 0.99
    transmittance_min: float = 1e-4
    absgrad: bool = False
    nonfinite: Literal["error", "skip", "trust"] = "error"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("mode", self.mode, [mode.value for mode in RasterizeMode])
        check_choice("nonfinite", self.nonfinite, ("error", "skip", "trust"))
        if self.sh_degree is not None:
            check_count("sh_degree", self.sh_degree, 0, MAX_SH_DEGREE)
        _ = self.projection, self.blending  # construction validates the numbers

    @property
    def projection(self) -> ProjectionOptions:
        antialiased = self.mode == RasterizeMode.ANTIALIASED
        return ProjectionOptions(
            self.eps2d, self.near, self.far, self.alpha_min, antialiased=antialiased
        )

    @property
    def blending(self) -> BlendOptions:
        return BlendOptions(self.alpha_min, self.alpha_max, self.transmittance_min, self.absgrad)


@dataclass(frozen=True, repr=False)
class GaussianRendering(Rendering):
    """Rendering of V images of N Gaussians."""

    radii: Tensor  # (V, N, 2) int32 half extents in px, 0 = not drawn


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    options: RenderOptions = RenderOptions(),
    *,
    background: Tensor | None = None,
    probe: Tensor | None = None,
    shader: Shader | None = None,
) -> GaussianRendering:
    """Render the Gaussians from every camera (Kerbl et al. 2023).

    Differentiable in the Gaussians, the poses and intrinsics of the cameras, the background, the
    probe and the shader.

    Example:

        import torch

        import dyngs

        scene = dyngs.load("runs/lego")
        cameras = dyngs.Cameras(
            torch.tensor([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]]),
            torch.tensor([[[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]]), 64, 48
        )
        image = dyngs.render(scene.gaussians, cameras).rgb[0]  # (48, 64, 3)

    Args:
        gaussians: N Gaussians, float32 (production), float64 (checks) or half (computed in
            float32).
        cameras: V cameras, on the device of the Gaussians.
        background: (3,) or (V, 3) colour; None = black.
        probe: (V, N, 4) zeros whose gradient is the densification signal, see ``rasterize``.
        shader: computes the colours; None: from the SH coefficients.

    Raises:
        DyngsError: NaN or infinite input (names the argument and the count), focal lengths that are
            not positive, a background or probe of another shape, cameras on another device than the
            Gaussians, or a render too large for memory.
    """
    if probe is not None and probe.shape != (len(cameras), len(gaussians), 4):
        raise DyngsError(
            f"probe must be ({len(cameras)}, {len(gaussians)}, 4), got {tuple(probe.shape)}"
        )
    gaussians, cameras, projection, opacities = _project(gaussians, cameras, background, options)
    colors = shade(gaussians, cameras, projection.radii, options, shader)
    # colours may overflow although all inputs are finite
    if options.nonfinite == "error":
        check_finite({"colors": colors}, "lower sh, or the weights of the network that colours")
    elif options.nonfinite == "skip":
        colors = colors.nan_to_num(0, 0, 0)
    if background is not None:
        background = background.to(colors).expand(len(cameras), 3)
    # With a low alpha_min, 1 - transmittance has fewer than four digits. The weights are then
    # summed in one more channel.
    needs_weights = options.depth == "expected" and options.alpha_min < 1 / 255
    if options.depth != "none":
        depths = projection.depths[..., None]
        more = [depths, torch.ones_like(depths)] if needs_weights else [depths]
        colors = torch.cat([colors, *more], dim=-1)
        if background is not None:
            background = torch.nn.functional.pad(background, (0, len(more)))
    size = (cameras.width, cameras.height)
    blended = rasterize(
        projection,
        opacities,
        colors,
        size,
        background=background,
        probe=probe,
        options=options.blending,
    )
    depth = None
    if options.depth != "none":
        depth = blended.color[..., 3]
        if options.depth == "expected":
            alpha = blended.color[..., 4] if needs_weights else 1 - blended.transmittance
            depth = depth / torch.where(alpha > 0, alpha, 1.0)
    return GaussianRendering(blended.color[..., :3], blended.transmittance, depth, projection.radii)


def contributions(
    gaussians: Gaussians, cameras: Cameras, options: RenderOptions = RenderOptions()
) -> Tensor:
    """Return the sums (V, N) over pixels of each Gaussian's blending weight, in pixels.

    Example:

        import torch

        import dyngs

        scene = dyngs.load("runs/lego")
        cameras = dyngs.Cameras(
            torch.tensor([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]]),
            torch.tensor([[[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]]), 64, 48
        )
        seen = dyngs.contributions(scene.gaussians, cameras).sum(0) > 0
    """
    return depths_and_contributions(gaussians, cameras, options)[1]


def depths_and_contributions(
    gaussians: Gaussians, cameras: Cameras, options: RenderOptions = RenderOptions()
) -> tuple[BlendedImages, Tensor]:
    """Return weighted depth images (V, H, W, 1) and the ``contributions`` (V, N)."""
    _, cameras, projection, opacities = _project(gaussians.detach(), cameras, None, options)
    size = (cameras.width, cameras.height)
    depths = projection.depths[..., None]
    return blend_and_tally(projection, opacities, depths, size, Tally.WEIGHTS, options.blending)


def sensitivities(
    gaussians: Gaussians,
    cameras: Cameras,
    options: RenderOptions = RenderOptions(),
    *,
    background: Tensor | None = None,
    shader: Shader | None = None,
) -> Tensor:
    """Return the sums (V, N) over pixels of (dI/dG)^2 (Tu et al. 2026).

    I is the sum of a pixel's channels, G the value of the 2D Gaussian at the pixel.
    """
    gaussians, cameras, projection, opacities = _project(
        gaussians.detach(), cameras, background, options
    )
    colors = shade(gaussians, cameras, projection.radii, options, shader)
    if background is not None:
        background = background.to(colors).expand(len(cameras), 3)
    size = (cameras.width, cameras.height)
    kind = Tally.SQUARED_SLOPES
    return tally(
        projection, opacities, size, kind, options.blending, colors=colors, background=background
    )


def shade(
    gaussians: Gaussians,
    cameras: Cameras,
    radii: Tensor,
    options: RenderOptions,
    shader: Shader | None = None,
) -> Tensor:
    """Return the colours (V, N, 3) of Gaussians; see ``Shader``. Without one from their SH."""
    if shader is not None:
        return shader(gaussians, cameras, radii)
    degree = (
        gaussians.sh_degree
        if options.sh_degree is None
        else min(options.sh_degree, gaussians.sh_degree)
    )
    return evaluate_harmonics(gaussians.means, cameras.centers, gaussians.sh, radii, degree)


def _project(
    gaussians: Gaussians, cameras: Cameras, background: Tensor | None, options: RenderOptions
) -> tuple[Gaussians, Cameras, Projection, Tensor]:
    """Return the validated Gaussians and cameras, projections, and opacities (V, N)."""
    gaussians, cameras = _validate_inputs(gaussians, cameras, background, options)
    opacities = gaussians.opacities
    projection = project(
        gaussians.means, gaussians.quats, gaussians.scales, opacities, cameras, options.projection
    )
    per_view = opacities.expand(len(cameras), -1)
    if options.mode == RasterizeMode.ANTIALIASED:
        per_view = per_view * projection.compensations
    return gaussians, cameras, projection, per_view


def _validate_inputs(
    gaussians: Gaussians, cameras: Cameras, background: Tensor | None, options: RenderOptions
) -> tuple[Gaussians, Cameras]:
    """Validate inputs and convert them to one dtype; handle non-finite values per ``options``."""
    check_background(background, len(cameras))
    if cameras.cam_from_world.device != gaussians.means.device:
        devices = f"the cameras are on {cameras.cam_from_world.device}, the Gaussians on {gaussians.means.device}"
        raise DyngsError(f"{devices}; move one of them with .to(device=...)")
    dtype = torch.float64 if gaussians.means.dtype == torch.float64 else torch.float32
    gaussians = gaussians.to(dtype=dtype)
    cameras = cameras.to(dtype=dtype)
    if options.nonfinite != "trust":
        check_views(cameras, background)
        gaussians = _handle_nonfinite(gaussians, options.nonfinite)
    return gaussians, cameras


def _handle_nonfinite(gaussians: Gaussians, policy: str) -> Gaussians:
    # exp(log_scales) overflows float32 from 88.8 on
    tensors_to_check = {**gaussians.tensors(), "exp(log_scales)": gaussians.scales.detach()}
    if policy == "error":
        check_finite(
            tensors_to_check,
            'clean the input, or render with nonfinite="skip" to leave these Gaussians out',
        )
        return gaussians
    keep = finite_rows(list(tensors_to_check.values()))
    if bool(keep.all()):
        return gaussians
    cleaned: dict[str, Tensor] = {}
    for name, x in gaussians.tensors().items():
        mask = keep.view(-1, *[1] * (x.ndim - 1))
        cleaned[name] = x.masked_fill(~mask, 0)
    # opacity exactly 0: culled, without gradient
    cleaned["logit_opacities"] = gaussians.logit_opacities.masked_fill(~keep, -1e4)
    return Gaussians(**cleaned)


def splat_options(splat: SplatFile) -> RenderOptions:
    """Return the render options stored in a splat file: mode, and low-pass filter if any."""
    options = RenderOptions(mode=splat.mode)
    return options if splat.eps2d is None else replace(options, eps2d=splat.eps2d)


def file_render_options(splat: SplatFile) -> RenderOptions:
    """Return ``splat_options`` with a near plane for the size of the scene."""
    means = splat.gaussians.means.double().numpy()
    distances = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    # Approximates the extent of cameras around the scene; the median ignores a far background.
    extent = 2 * float(np.median(distances))
    return (
        replace(splat_options(splat), near=near_plane(extent)) if extent else splat_options(splat)
    )
