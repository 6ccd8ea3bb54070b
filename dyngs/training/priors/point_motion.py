"""Motion of a model in images, compared with optical flow and 2D tracks.

Gaussians carry where they go in the other image as their colour; what is drawn is the displacement of each pixel,
with the weights of its colours. Both train the field of motion alone, not the canonical Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.data.loader import Image
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render

_SOLID = 0.5
_SOFT_PX = 0.5  # Charbonnier's constant, px: smaller errors count quadratically


@dataclass(frozen=True)
class Glance:
    """The camera and time of another image of the same scene."""

    cameras: Cameras
    time: float


def displacements(start: Gaussians, end: Gaussians, here: Cameras, there: Cameras, options: RenderOptions) -> Tensor:
    """Return (H, W, 3): mean displacement (x, y) in px of the images' size, and the sum of weights it stands for.

    Differentiable in the means of both, not in how much each Gaussian covers.
    """
    (from_px, from_z), (to_px, to_z) = _projected(start.means, here), _projected(end.means, there)
    seen = (from_z > options.near) & (to_z > options.near)
    limit = float(here.width + here.height)
    moved = torch.where(seen[:, None], to_px - from_px, 0.0).clamp(-limit, limit)
    carried = torch.cat([moved, seen[:, None].to(moved)], dim=1)[None]
    drawn = render(start.detach(), here, options, shader=lambda *_: carried).rgb[0]
    total = drawn[..., 2:]
    return torch.cat([drawn[..., :2] / total.detach().clamp_min(0.1), total], dim=-1)


def flow_error(drawn: Tensor, image: Image) -> Tensor | None:
    """Return the mean Charbonnier error of ``drawn`` (see ``displacements``) in the flow of an image.

    In fractions of the image's longer side, over pixels whose flow is known; None without any.
    """
    flow = image.flow
    if flow is None:
        return None
    counts = flow.isfinite().all(-1) & (drawn[..., 2].detach() > _SOLID)
    if image.mask is not None:
        counts = counts & (image.mask > 0)
    if not bool(counts.any()):
        return None
    return _charbonnier(drawn[..., :2][counts] - flow[counts]).mean() / max(counts.shape)


def track_error(drawn: Tensor, start: Tensor, end: Tensor) -> Tensor | None:
    """Return the mean Charbonnier error of ``drawn`` at the points ``start`` (P, 2) px, which are at ``end`` (P, 2).

    In fractions of the image's longer side; None where no point lies on anything drawn.
    """
    height, width = drawn.shape[:2]
    grid = (2 * start / start.new_tensor([width, height]) - 1)[None, None]
    sampled = torch.nn.functional.grid_sample(drawn.permute(2, 0, 1)[None], grid, align_corners=False)[0, :, 0].T
    counts = sampled[:, 2].detach() > _SOLID
    if not bool(counts.any()):
        return None
    return _charbonnier((start + sampled[:, :2] - end)[counts]).mean() / max(height, width)


def _charbonnier(errors: Tensor) -> Tensor:
    return (errors.square().sum(-1) + _SOFT_PX**2).sqrt() - _SOFT_PX


def _projected(means: Tensor, cameras: Cameras) -> tuple[Tensor, Tensor]:
    pose, k = cameras.cam_from_world[0], cameras.intrinsics[0]
    local = means @ pose[:3, :3].T + pose[:3, 3]
    depth = local[:, 2]
    return local[:, :2] / depth.clamp_min(1e-6)[:, None] * k.diagonal()[:2] + k[:2, 2], depth
