"""3D smoothing filter of Mip-Splatting: limits Gaussians to what the training cameras resolve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from dyngs.core.camera import Cameras
from dyngs.core.state import Role, State, StateTensor
from dyngs.core.tensor_checks import require_tensor
from dyngs.gaussians import Gaussians

FILTER_VARIANCE = 0.2  # variance of the filter, in squared sampling intervals
NEAR = 0.2
# A camera sees points inside the image enlarged by this fraction on each side.
MARGIN = 0.15


def filter_std(means: Tensor, cameras: Sequence[Cameras]) -> Tensor:
    """Return the standard deviation (N,) of the 3D filter in world units.

    sqrt(0.2) * nearest depth / largest focal length. The nearest depth is over the cameras that
    see a Gaussian at a depth above 0.2. Gaussians that no camera sees get the largest nearest
    depth (1 if there is none). Constant with respect to gradients.
    """
    means = means.detach()
    nearest = torch.full((len(means),), torch.inf, device=means.device)
    cameras = [group.to(device=means.device) for group in cameras]
    focal = max(float(group.intrinsics[:, 0, 0].max()) for group in cameras)
    for group in cameras:
        for pose, intrinsics in zip(group.cam_from_world, group.intrinsics, strict=True):
            depth = _visible_depth(means, pose, intrinsics, group.width, group.height)
            nearest = torch.minimum(nearest, depth)
    seen = torch.isfinite(nearest)
    farthest = nearest[seen].max() if bool(seen.any()) else torch.tensor(1.0, device=means.device)
    return torch.where(seen, nearest, farthest) * (FILTER_VARIANCE**0.5 / focal)


def _visible_depth(
    means: Tensor, pose: Tensor, intrinsics: Tensor, width: int, height: int
) -> Tensor:
    """Return the depth (N,) in one camera; infinite for points that it does not see."""
    # A matrix product would depend on the number of threads.
    rotation = pose[:3, :3]
    translation = pose[:3, 3]
    x, y, z = (
        (means * row).sum(1) + shift for row, shift in zip(rotation, translation, strict=True)
    )
    u = (intrinsics[0, 0] * x + intrinsics[0, 1] * y) / z + intrinsics[0, 2]
    v = intrinsics[1, 1] * y / z + intrinsics[1, 2]
    inside = (
        (u >= -MARGIN * width)
        & (u <= (1 + MARGIN) * width)
        & (v >= -MARGIN * height)
        & (v <= (1 + MARGIN) * height)
    )
    return torch.where(inside & (z > NEAR), z, torch.inf)


def fuse_filter(gaussians: Gaussians, std: Tensor) -> Gaussians:
    """Convolve Gaussians with the filter: s' = sqrt(s^2 + f^2), o' = o * prod_k s_k / s'_k.

    Differentiable. Computed in logarithms per axis, because products of scales underflow. The
    logit of o' is taken from log o' and 1 - o' = (1 - o) + o (1 - prod), both sums of positive
    terms.
    """
    log_scales = torch.logaddexp(2 * gaussians.log_scales, 2 * std.log()[:, None]) / 2
    log_ratio = (gaussians.log_scales - log_scales).sum(1).clamp_max(0)
    logits = gaussians.logit_opacities
    # The last bit of sigmoid depends on the number of threads.
    log_opacity = logsigmoid(logits)
    missing = logsigmoid(-logits).exp() - log_opacity.exp() * torch.expm1(log_ratio)
    fused = log_opacity + log_ratio - missing.clamp_min(torch.finfo(missing.dtype).tiny).log()
    return gaussians.replace(log_scales=log_scales, logit_opacities=fused)


def apply_filter(gaussians: Gaussians, std: Tensor | None) -> Gaussians:
    """Apply the 3D filter (N,) to the Gaussians; None: return them unchanged."""
    return gaussians if std is None else fuse_filter(gaussians, std)


def filter_state(std: Tensor | None) -> State:
    """Return the state of a 3D filter; empty without one."""
    return {} if std is None else {"filter_std": StateTensor(std, Role.PER_GAUSSIAN)}


def restore_filter(tensors: Mapping[str, Tensor], count: int) -> Tensor | None:
    """Return the 3D filter (N,) in a state, or None. Raises ValueError if it does not match N."""
    std = tensors.get("filter_std")
    if std is not None and bool((require_tensor("filter_std", std, (count,)) < 0).any()):
        raise ValueError("'filter_std' holds negative numbers")
    return std


class FilterUpdate:
    """Recomputes the 3D filter of Mip-Splatting at given steps, and after every topology edit.

    Args:
        cameras: the training cameras; empty: no filter.
        steps: steps after which the filter is recomputed.
    """

    def __init__(self, cameras: Sequence[Cameras] = (), steps: range = range(0)) -> None:
        self.cameras, self.steps = cameras, steps

    def compute(self, gaussians: Gaussians) -> Tensor | None:
        return filter_std(gaussians.means, self.cameras) if self.cameras else None

    def is_due(self, step: int, edited: bool) -> bool:
        return bool(self.cameras) and (edited or step in self.steps)
