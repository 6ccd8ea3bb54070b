"""Baking of a colour network into SH: exact where representable, with a residual otherwise."""

from __future__ import annotations

import pytest
import torch
from scenes import random_scene
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.gaussians import Gaussians
from dyngs.gaussians.colour.network import bake_harmonics
from dyngs.gaussians.rendering import Shader
from dyngs.ops.harmonics import evaluate_harmonics


def harmonics_shader(sh: Tensor, degree: int) -> Shader:
    def colors(gaussians: Gaussians, cameras: Cameras, radii: Tensor) -> Tensor:
        return evaluate_harmonics(gaussians.means, cameras.centers, sh, radii, degree)

    return colors


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_baking_recovers_known_harmonics(degree: int) -> None:
    gaussians = random_scene(n=8, degree=degree).gaussians
    sh = 0.1 * gaussians.sh  # no colour is clamped
    baked = bake_harmonics(gaussians, harmonics_shader(sh, degree), 3)
    assert baked.gaussians.sh.shape == (8, 16, 3)
    # the eye is 1e4 times farther than the Gaussians, not infinitely far
    torch.testing.assert_close(baked.gaussians.sh[:, : sh.shape[1]], sh, rtol=0, atol=1e-4)
    torch.testing.assert_close(
        baked.gaussians.sh[:, sh.shape[1] :],
        torch.zeros_like(baked.gaussians.sh[:, sh.shape[1] :]),
        rtol=0,
        atol=1e-4,
    )
    assert baked.error < 1e-4
    assert torch.equal(baked.gaussians.means, gaussians.means)


def test_error_is_the_residual_of_the_fit() -> None:
    """White from one half of all directions, black from the other: degree 0 can only be grey."""
    gaussians = random_scene(n=3, degree=0).gaussians

    def half(gaussians: Gaussians, cameras: Cameras, radii: Tensor) -> Tensor:
        white = (cameras.centers[:, 2] > 0).double()
        return white[:, None, None].expand(len(cameras), len(gaussians), 3)

    baked = bake_harmonics(gaussians, half, 0)
    torch.testing.assert_close(
        baked.gaussians.base_rgb, torch.full((3, 3), 0.5, dtype=torch.float64)
    )
    assert baked.error == pytest.approx(0.5)
    assert bake_harmonics(gaussians, half, 3).error < 0.25
