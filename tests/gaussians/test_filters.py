"""Mip-Splatting's 3D filter: known widths, exact in float64, stable where products underflow."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.core.camera import Cameras
from dyngs.gaussians import Gaussians
from dyngs.gaussians.filters import filter_std, fuse_filter


def _camera(z: float, focal: float = 100.0) -> Cameras:
    """A camera at (0, 0, -z) that looks along +z, 200 x 100 pixels."""
    pose = torch.eye(4)
    pose[2, 3] = z
    intrinsics = torch.tensor([[focal, 0.0, 100.0], [0.0, focal, 50.0], [0.0, 0.0, 1.0]])
    return Cameras(pose[None], intrinsics[None], 200, 100)


def _gaussians(scales: torch.Tensor, logits: torch.Tensor) -> Gaussians:
    n = len(scales)
    quats = torch.zeros(n, 4, dtype=scales.dtype)
    return Gaussians(
        torch.zeros(n, 3, dtype=scales.dtype), quats, scales.log(), logits, quats.new_zeros(n, 1, 3)
    )


def test_width_follows_the_nearest_camera_that_sees_it() -> None:
    #                    centre           off to the side  outside both      behind both
    means = torch.tensor([[0.0, 0.0, 0.0], [2.2, 0.0, 0.0], [20.0, 0.0, 0.0], [0.0, 0.0, -9.0]])
    near = _camera(2.0)
    far = _camera(4.0, focal=50.0)
    std = filter_std(means, [near, far])
    # The second is at pixel 100 + 110 = 210 <= 230 in the near camera; the others take the largest
    # depth.
    expected = torch.tensor([2.0, 2.0, 2.0, 2.0]) / 100 * math.sqrt(0.2)
    torch.testing.assert_close(std, expected)
    only_far = filter_std(torch.tensor([[2.7, 0.0, 0.0], [0.0, 0.0, 0.0]]), [near, far])
    torch.testing.assert_close(only_far, torch.tensor([4.0, 2.0]) / 100 * math.sqrt(0.2))


@settings(max_examples=25, deadline=None)
@given(st.floats(-12, 12), st.floats(1e-3, 10), st.floats(1e-3, 10))
def test_fused_filter_equals_the_formula(logit: float, scale: float, std: float) -> None:
    scales = torch.tensor([[scale, 2 * scale, 3 * scale]], dtype=torch.float64)
    gaussians = _gaussians(scales, torch.tensor([logit], dtype=torch.float64))
    fused = fuse_filter(gaussians, torch.tensor([std], dtype=torch.float64))
    wide = (scales**2 + std**2).sqrt()
    torch.testing.assert_close(fused.scales, wide)
    torch.testing.assert_close(
        fused.opacities, gaussians.opacities * (scales / wide).prod(1), rtol=1e-9, atol=0
    )


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1.0, 1e12])
@pytest.mark.parametrize("logit", [-100.0, 0.0, 100.0])
@pytest.mark.parametrize("std", [0.0, 1e-20, 1.0])
def test_extremes_stay_finite(scale: float, logit: float, std: float) -> None:
    gaussians = _gaussians(torch.full((1, 3), scale), torch.tensor([logit]))
    gaussians.log_scales.requires_grad_()
    gaussians.logit_opacities.requires_grad_()
    fused = fuse_filter(gaussians, torch.tensor([std]))
    assert torch.isfinite(fused.log_scales).all()
    assert torch.isfinite(fused.logit_opacities).all()
    (fused.log_scales.sum() + fused.logit_opacities.sum()).backward()
    for x in (gaussians.log_scales, gaussians.logit_opacities):
        assert x.grad is not None
        assert torch.isfinite(x.grad).all()
