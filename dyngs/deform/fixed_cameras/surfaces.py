"""What stands and looks different at some times: shadows, lights, screens, and surfaces that turn
in place.

Local letters: V cameras, N Gaussians of a static scene.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyngs.core.conventions import SH_C0
from dyngs.deform.fixed_cameras.changes import Footage
from dyngs.deform.fixed_cameras.seeds import LOGIT, Moment
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.ops.quaternions import rotate

SHOWS = 0.1  # Sum of weights, in pixels, from which a Gaussian counts as visible in an image
FEWEST_CAMERAS = 2  # That must see a Gaussian: what one sees may be before it
CHANGE = 0.05  # Least change of a channel, of 1
LIFT = 0.5  # Distance of a copy before its original, in longest standard deviations


def surface_changes(
    footage: Sequence[Footage], still: Gaussians, options: RenderOptions, limit: int
) -> list[Moment]:
    """Return copies of ``still`` Gaussians at the times at which most cameras see another colour
    there, in this colour.

    The change of a Gaussian is the median over cameras of sum_p w_p (truth - median) / sum_p w_p
    with w = alpha T; that of what is only covered by something else differs from camera to camera.
    At most ``limit``, those that change most.
    """
    graphs = [_blended(still, one, options) for one in footage]
    towards = torch.cat([one.camera.centers for one in footage]).to(still.means).mean(0)
    found: list[tuple[float, Tensor, Tensor]] = []
    for time in sorted({time for one in footage for time in one.times}):
        seen: list[Tensor] = []
        for one, (flat, blended, weights) in zip(footage, graphs, strict=True):
            if time not in one.times:
                continue
            i = one.times.index(time)
            error = (
                torch.from_numpy(one.images[i]).float() - torch.from_numpy(one.median).float()
            ) / 255
            error = (error * torch.from_numpy(one.counted[i])[..., None]).to(blended)
            (sums,) = torch.autograd.grad(blended, flat, error, retain_graph=True)
            seen.append(torch.where(weights > SHOWS * SH_C0, sums[:, 0] / weights, torch.nan))
        change = torch.stack(seen)
        usual = change.nanmedian(0).values
        rows = torch.nonzero(
            (usual.abs().amax(1) > CHANGE) & ((~change[..., 0].isnan()).sum(0) >= FEWEST_CAMERAS)
        )[:, 0]
        found.append((time, rows, usual[rows]))
    sizes = torch.cat([usual.abs().amax(1) for _, _, usual in found]).sort(descending=True).values
    least = float(sizes[limit]) if len(sizes) > limit else 0.0
    moments: list[Moment] = []
    for time, rows, usual in found:
        kept = usual.abs().amax(1) > least
        if bool(kept.any()):
            copies = _recoloured(still.select(rows[kept]), usual[kept], towards)
            moments.append(Moment(time, copies, still.means.new_zeros(3)))
    return moments


def _blended(
    still: Gaussians, one: Footage, options: RenderOptions
) -> tuple[Tensor, Tensor, Tensor]:
    """Return a constant colour, its blending, and the (N, 1) sums of weights, of every Gaussian in
    one camera."""
    flat = torch.zeros(len(still), 1, 3, requires_grad=True, device=still.means.device)
    blended = render(still.replace(sh=flat), one.camera.to(device=still.means.device), options).rgb[
        0
    ]
    (weights,) = torch.autograd.grad(blended, flat, torch.ones_like(blended), retain_graph=True)
    return flat, blended, weights[:, 0, :1]


def _recoloured(gaussians: Gaussians, change: Tensor, towards: Tensor) -> Gaussians:
    """Return ``gaussians`` with other base colours, a little before themselves as seen from
    ``towards`` (3,)."""
    shortest = torch.nn.functional.one_hot(gaussians.log_scales.argmin(1), 3).to(gaussians.means)
    normals = rotate(gaussians.quats, shortest)
    signs = ((towards - gaussians.means) * normals).sum(1, keepdim=True).sign()
    lift = LIFT * gaussians.scales.amax(1, keepdim=True)
    sh = gaussians.sh.clone()
    sh[:, 0] += change / SH_C0
    logits = gaussians.logit_opacities.clamp_min(LOGIT)
    return gaussians.replace(
        means=gaussians.means + signs * lift * normals, sh=sh, logit_opacities=logits
    )
