"""The reference itself: its gradients by gradcheck, its values where they are known."""

from __future__ import annotations

import math

import pytest
import reference
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.ops.projection import Projection

pytestmark = pytest.mark.usefixtures("one_thread")


def one_camera(width: int = 8, height: int = 8, focal: float = 50.0) -> Cameras:
    intrinsics = torch.tensor(
        [[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]], dtype=torch.float64
    )
    return Cameras(torch.eye(4, dtype=torch.float64)[None], intrinsics, width, height)


def flat_splats(alphas: list[float], depths: list[float]) -> tuple[Projection, Tensor]:
    """Splats so wide that alpha is their opacity everywhere."""
    n = len(alphas)
    zeros = torch.zeros(1, n, 2, dtype=torch.float64)
    factors = torch.tensor([1e-12, 0.0, 1e-12], dtype=torch.float64).expand(1, n, 3)
    ones = torch.ones(1, n, dtype=torch.float64)
    depth = torch.tensor([depths], dtype=torch.float64)
    projection = Projection(
        zeros, depth, factors, ones, torch.full((1, n, 2), 100, dtype=torch.int32)
    )
    return projection, torch.tensor([alphas], dtype=torch.float64)


def test_ball_on_the_optical_axis() -> None:
    """Variance (focal scale / z)^2 + eps, mean on the principal point, extent by the opacity."""
    sigma, z, opacity = 0.2, 4.0, 0.7
    cameras = one_camera()
    args = ([[0.0, 0, z]], [[1.0, 0, 0, 0]], [[sigma] * 3], [opacity])
    p = reference.project(*(torch.tensor(x, dtype=torch.float64) for x in args), cameras)
    bare = (50 * sigma / z) ** 2
    variance = bare + 0.3
    assert p.means2d.tolist() == [[[4.0, 4.0]]]
    assert p.depths.item() == z
    torch.testing.assert_close(
        p.conics[0, 0], torch.tensor([1 / variance, 0, 1 / variance]).double()
    )
    assert p.compensations.item() == pytest.approx(bare / variance)
    assert (
        p.radii[0, 0].tolist() == [math.ceil(math.sqrt(2 * math.log(opacity * 255) * variance))] * 2
    )


def test_blending_two_flat_layers() -> None:
    projection, opacities = flat_splats([0.5, 0.25], depths=[2.0, 1.0])  # the second is in front
    colors = torch.tensor([[[1.0], [10.0]]], dtype=torch.float64)
    background = torch.tensor([[100.0]], dtype=torch.float64)
    blended = reference.rasterize(projection, opacities, colors, (3, 2), background=background)
    expected = 0.25 * 10 + 0.75 * 0.5 * 1 + 0.75 * 0.5 * 100
    torch.testing.assert_close(
        blended.color, torch.full((1, 2, 3, 1), expected, dtype=torch.float64)
    )
    torch.testing.assert_close(
        blended.transmittance, torch.full((1, 2, 3), 0.375, dtype=torch.float64)
    )


def test_harmonics_are_orthonormal() -> None:
    """Quadrature that is exact up to degree 9: Gauss-Legendre in z, equal steps around it."""
    import numpy as np

    nodes, node_weights = np.polynomial.legendre.leggauss(6)
    angles = torch.arange(12, dtype=torch.float64) * (2 * math.pi / 12)
    z, phi = torch.meshgrid(torch.from_numpy(nodes), angles, indexing="ij")
    ring = (1 - z * z).sqrt()
    directions = torch.stack([ring * phi.cos(), ring * phi.sin(), z], -1)
    basis = reference.harmonics_basis(directions, 4)
    gram = torch.einsum(
        "i,ijk,ijl->kl", torch.from_numpy(node_weights) * (2 * math.pi / 12), basis, basis
    )
    torch.testing.assert_close(gram, torch.eye(25, dtype=torch.float64))
