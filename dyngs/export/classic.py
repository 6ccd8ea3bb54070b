"""Gaussians for viewers that render without antialiasing, or without SH coefficients."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0, RasterizeMode
from dyngs.core.errors import log_info
from dyngs.core.gaussians import Gaussians
from dyngs.export.camera_paths import pick_cameras, spread_rows
from dyngs.export.images import compare_with_images
from dyngs.gaussians.rendering import RenderOptions, contributions, render, splat_options
from dyngs.io.formats.packing import logit
from dyngs.io.formats.splat_file import SplatFile, with_sh_degree
from dyngs.ops.harmonics import evaluate_harmonics
from dyngs.ops.loss import l1_ssim_loss
from dyngs.ops.projection import Projection, project

CLASSIC = RenderOptions()
"""What viewers without antialiasing render: 0.3 px^2 are added, opacities stay as they are."""
MOST_VIEWS = 70
CHECKED = 7  # every seventh of these views measures the fit, the others are fitted
MAX_OPACITY = 1 - 1e-6
GOOD_PSNR = 35.0  # dB; below it, the closed form is followed by an optimisation
NUM_STEPS = 240
RATES = {"log_scales": 0.01, "logit_opacities": 0.05, "sh": 0.01}
"""Learning rates of the optimisation."""
SMALLEST = 0.1  # fraction of a variance that remains at least; 0.02 and 0.25 differ by 0.1 dB


@torch.no_grad()
def fit_classic(
    splat: SplatFile, cameras: Cameras, near: float, sh_degree: int
) -> tuple[SplatFile, str]:
    """Return a scene changed for classic viewers if that helps, and a note with its PSNR.

    Variances shrink by what the low-pass of these viewers exceeds that of the scene. Opacities are
    multiplied by the mean ratio of both renderings at the centre of a Gaussian. Colours of SH
    degree 0 are the mean over the views. Views weigh by the contribution of the Gaussian. If that
    gives less than ``GOOD_PSNR``, an optimisation follows.

    Args:
        cameras: V cameras in the axes of the file, at the resolution to fit.
        near: near plane in units of the file.
        sh_degree: SH degree of the format; only 0 changes the colours.
    """
    source = replace(splat_options(splat), near=near)
    target = replace(CLASSIC, near=near)
    rows = spread_rows(len(cameras), MOST_VIEWS)
    is_checked = np.arange(len(rows)) % CHECKED == CHECKED // 2
    checked = pick_cameras(cameras, rows[is_checked] if is_checked.any() else rows)
    fitted = pick_cameras(cameras, rows[~is_checked])
    own = splat.gaussians
    sh_degree = min(sh_degree, own.sh_degree)
    unchanged = replace(
        splat, gaussians=with_sh_degree(own, sh_degree), mode=target.mode, eps2d=None
    )
    shape, colours = _fit(own, fitted, source, target)
    parts = "opacities and scales"
    if sh_degree == 0 and own.sh_degree > 0:
        parts = "opacities, scales and mean colours"
        shape = shape.replace(sh=((colours - 0.5) / SH_C0)[:, None])
    changed = replace(unchanged, gaussians=with_sh_degree(shape, sh_degree))
    wanted = render(own, checked, source).rgb
    before = compare_with_images(wanted, checked, unchanged, near)
    after = compare_with_images(wanted, checked, changed, near)
    if after < GOOD_PSNR:
        log_info(f"optimizing {len(own):,} Gaussians for viewers without antialiasing")
        better = _optimize(changed.gaussians, own, fitted, source, target)
        optimized = replace(changed, gaussians=better)
        result = compare_with_images(wanted, checked, optimized, near)
        if result > after:
            changed, after = (optimized, result)
    text = f"no change needed, {before:.1f} dB"
    if after > before:
        text = f"{parts} fitted, {before:.1f} -> {after:.1f} dB"
    size = f"{cameras.width}x{cameras.height} px"
    note = f"for viewers without antialiasing at {size}: {text} (PSNR)"
    return changed if after > before else unchanged, note


def _fit(
    own: Gaussians, cameras: Cameras, source: RenderOptions, target: RenderOptions
) -> tuple[Gaussians, Tensor]:
    """Return the Gaussians with the shapes that ``target`` needs, and their mean colours (N, 3).

    Gaussians that no camera sees are unchanged.
    """
    weights = []
    footprints = own.means.new_zeros(len(own))
    colours = own.means.new_zeros(len(own), 3)
    total = torch.zeros_like(footprints)
    for camera in cameras:
        weight = contributions(own, camera, source)[0]
        projection = _project(own, camera, source)
        rgb = evaluate_harmonics(
            own.means, camera.centers, own.sh, projection.radii, own.sh_degree
        )[0]
        # area of a pixel at the depth of the Gaussian
        footprints += weight * (projection.depths[0] / camera.intrinsics[0, 0, 0]).square()
        colours += weight[:, None] * rgb
        total += weight
        weights.append(weight)
    seen = total > 0
    total = total.clamp_min(torch.finfo(total.dtype).tiny)
    variances = own.scales.square()
    excess = (target.eps2d - source.eps2d) * footprints / total
    variances = torch.maximum(variances - excess[:, None], SMALLEST * variances)
    shape = own.replace(log_scales=variances.log() / 2)
    ratios = own.means.new_zeros(len(own))
    for camera, weight in zip(cameras, weights, strict=True):
        before = _project(own, camera, source)
        after = _project(shape, camera, target)
        # Areas after the low-pass are inverse to these products. A view without the Gaussian has no
        # area, and weight 0.
        sharpness = [(x.factors[0, :, 0] * x.factors[0, :, 2]).abs() for x in (before, after)]
        ratio = (sharpness[1] / sharpness[0]).nan_to_num(0, 0, 0)
        if source.mode is RasterizeMode.ANTIALIASED:
            ratio = ratio * before.compensations[0]
        ratios += weight * ratio
    opacities = own.opacities * torch.where(seen, ratios / total, 1.0)
    logits = torch.from_numpy(logit(opacities.clamp_max(MAX_OPACITY).numpy()))
    shape = shape.replace(logit_opacities=torch.where(seen, logits, own.logit_opacities))
    return shape, torch.where(seen[:, None], colours / total[:, None], own.base_rgb)


def _optimize(
    start: Gaussians, own: Gaussians, cameras: Cameras, source: RenderOptions, target: RenderOptions
) -> Gaussians:
    """Return ``start`` after Adam steps on the difference between both renderings."""
    views = list(cameras)
    parameters = {name: getattr(start, name).clone().requires_grad_() for name in RATES}
    groups = [{"params": [parameters[name]], "lr": rate} for name, rate in RATES.items()]
    optimizer = torch.optim.Adam(groups, eps=1e-15)
    for step in range(NUM_STEPS):
        view = views[step % len(views)]
        # rendered again each time: all images of a large capture take gigabytes
        wanted = render(own, view, source).rgb[0]
        with torch.enable_grad():
            image = render(start.replace(**parameters), view, target).rgb[0]
            loss = l1_ssim_loss(image, wanted)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return start.replace(**{name: value.detach() for name, value in parameters.items()})


def _project(gaussians: Gaussians, camera: Cameras, options: RenderOptions) -> Projection:
    opacities = gaussians.opacities
    return project(
        gaussians.means, gaussians.quats, gaussians.scales, opacities, camera, options.projection
    )
