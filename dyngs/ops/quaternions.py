"""Quaternions of any length made unit quaternions, as the kernels do it (``normalize`` in csrc/math/projection.hpp)."""

from __future__ import annotations

import torch
from torch import Tensor

SHORTEST = 1e-12
"""Size of the largest entry below which the gradient grows no further; the value is exact down to denormals."""


def unit_quats(quats: Tensor) -> Tensor:
    """(..., 4) unit quaternions wxyz along ``quats`` of any length; zero becomes the identity, with a gradient of zero.

    Divided by the largest entry first, so that no square leaves the range of floats. NaN and infinity give NaN.
    """
    largest = quats.detach().abs().amax(-1, keepdim=True)
    zero = largest == 0
    scaled = quats / largest.clamp_min(SHORTEST)
    exact = quats.detach() / torch.where(zero, 1, largest)
    scaled = scaled + (exact - scaled).detach()  # another value where a quaternion is short, the gradient as it was
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    scaled = torch.where(zero, identity, scaled)
    return scaled / scaled.norm(dim=-1, keepdim=True)
