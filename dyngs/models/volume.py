"""Volume rendering of radiance fields: the rays of cameras, and fewer samples for the networks.

Of samples that hardly show one in four is taken, which stands for the others, too.
R rays, M samples. A sample within an occupied cell but before or behind the surface costs as much
as one that is seen, and says as little as its neighbours.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.ops.rays import Rays, Samples, composite, offsets_of, reached

LIGHT = 5e-3  # Weight below which a sample hardly shows
EVERY = 4  # So many of those are one


def camera_rays(cameras: Cameras, pixels: Tensor | None = None) -> tuple[Rays, Tensor]:
    """Return the rays of one camera through the centres of ``pixels`` (R,), row by row; None: of
    all.

    Also (R,) the view-space z of what lies a unit along each.
    """
    if pixels is None:
        pixels = torch.arange(cameras.width * cameras.height, device=cameras.intrinsics.device)
    intrinsics = cameras.intrinsics[0]
    pose = cameras.cam_from_world[0]
    x = pixels % cameras.width + 0.5
    y = torch.div(pixels, cameras.width, rounding_mode="floor") + 0.5
    local = torch.stack(
        [
            (x - intrinsics[0, 2]) / intrinsics[0, 0],
            (y - intrinsics[1, 2]) / intrinsics[1, 1],
            torch.ones_like(x),
        ],
        -1,
    ).to(pose.dtype)
    z = 1 / local.square().sum(-1).sqrt()
    local = local * z[:, None]
    rotation = pose[:3, :3]
    directions = (
        local[:, :1] * rotation[0] + local[:, 1:2] * rotation[1] + local[:, 2:] * rotation[2]
    )
    return Rays(cameras.centers.expand(len(x), 3), directions), z


@torch.no_grad()
def visible_samples(
    densities: Tensor, samples: Samples, shifts: Tensor | None = None
) -> tuple[Samples, Tensor]:
    """Return the samples (K) that light gets to, and their indices (K,) among all.

    With ``shifts``, faint ones are thinned to every fourth, four times as long around the same
    midpoint. What rays see, and the gradients by densities, are on average those of all samples.

    Args:
        densities: (M,) per world unit.
        samples: M samples of R rays.
        shifts: (R,) in [0, 1): which of four it is, at random for each ray; None: no thinning.
    """
    through, offsets = reached(densities, samples)
    if shifts is None:
        return _chosen(samples, through, offsets)
    weights = composite(densities, densities[:, None].expand(-1, 3).contiguous(), samples).weights
    place = (
        torch.arange(len(samples), device=densities.device)
        + (shifts * EVERY).long()[samples.rays.long()]
    )
    light = weights < LIGHT
    chosen = through & (~light | (place % EVERY == 0))
    more = light.to(densities) * ((EVERY - 1) / 2) * (samples.ends - samples.starts)
    return select_samples(
        replace(samples, starts=samples.starts - more, ends=samples.ends + more), chosen
    )


@torch.no_grad()
def select_samples(samples: Samples, chosen: Tensor) -> tuple[Samples, Tensor]:
    """Return the samples (K) that are ``chosen`` (M,) bool, and their indices (K,) among all."""
    counts = torch.zeros(samples.num_rays, dtype=torch.int64, device=chosen.device)
    counts.index_add_(0, samples.rays.long(), chosen.long())
    return _chosen(samples, chosen, offsets_of(counts))


def _chosen(samples: Samples, chosen: Tensor, offsets: Tensor) -> tuple[Samples, Tensor]:
    which = chosen.nonzero()[:, 0]
    rays = samples.rays[which].long()
    return Samples(
        offsets, rays, samples.starts[which], samples.ends[which], samples.coords[which]
    ), which
