"""The Gaussians that training starts from: sparse points of the capture, or random ones."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.config import DefaultStrategy, FixedStrategy, McmcStrategy, PointsInit, RandomInit, Strategy
from dyngs.conventions import SH_C0, num_sh_terms
from dyngs.gaussians import Gaussians

START_OPACITY = 0.1
MCMC_OPACITY, MCMC_SCALE = 0.5, 0.1
"""Opacity, and scale in distances to neighbours, that 3DGS-MCMC begins with."""
MIN_SQUARED_DISTANCE = 1e-7
EXTENT_MARGIN = 1.1
CUBE_PER_EXTENT = 3.0
"""Half the side of the cube of random points per camera extent, for captures without a convention of their own."""


@dataclass(frozen=True)
class StartValues:
    """Scales and opacities of the first Gaussians, by strategy.

    Attributes:
        opacity: in (0, 1).
        scale_factor: multiplies the distance to the nearest neighbours.
        max_gaussians: more points than this are thinned at random.
    """

    opacity: float = START_OPACITY
    scale_factor: float = 1.0
    max_gaussians: int = 3_000_000

    @staticmethod
    def for_strategy(strategy: Strategy) -> StartValues:
        """Return the published start of ``strategy`` (3DGS-MCMC: more opaque and smaller)."""
        match strategy:
            case McmcStrategy():
                return StartValues(MCMC_OPACITY, MCMC_SCALE, strategy.max_gaussians)
            case DefaultStrategy():
                return StartValues(max_gaussians=strategy.max_gaussians)
            case FixedStrategy():
                return StartValues()


@dataclass(frozen=True)
class Surroundings:
    """Cameras and extent of a scene before training, in world units.

    Attributes:
        camera_centers: (V, 3) of the training cameras.
        points: (P, 3) sparse points, or None.
        points_rgb: (P, 3) their colours, uint8; None without points.
        around_origin: the scene lies around the origin by convention (Blender scenes).
    """

    camera_centers: np.ndarray
    points: np.ndarray | None = None
    points_rgb: np.ndarray | None = None
    around_origin: bool = False

    @property
    def extent(self) -> float:
        """1.1 x the largest distance of a camera's centre to the mean centre.

        Learning rates and size thresholds are relative to it. Where all cameras share one centre it is 1.
        """
        offsets = self.camera_centers - self.camera_centers.mean(axis=0)
        extent = EXTENT_MARGIN * float(np.linalg.norm(offsets, axis=1).max())
        return extent if extent > 1e-6 else 1.0


def initial_gaussians(
    scene: Surroundings,
    options: PointsInit | RandomInit,
    start: StartValues,
    sh_degree: int,
    generator: torch.Generator,
) -> Gaussians:
    """Return the first Gaussians of a run: isotropic, as large as the distance to the three nearest neighbours.

    ``RandomInit`` draws a cube around the origin. ``PointsInit`` takes the finite ones of the scene's points; where
    there are none it draws a cube, around the origin or else around the cameras' mean and as large as their extent.

    Args:
        generator: a CPU generator; the only source of randomness.
    """
    if options.kind != "random" and scene.points is not None and scene.points_rgb is not None:
        finite = np.isfinite(scene.points).all(axis=1)
        xyz = torch.from_numpy(scene.points[finite].astype(np.float64))
        base = (torch.from_numpy(scene.points_rgb[finite].astype(np.float64)) / 255 - 0.5) / SH_C0
        if len(xyz) > start.max_gaussians:
            chosen = torch.randperm(len(xyz), generator=generator, device="cpu")[: start.max_gaussians].sort().values
            xyz, base = xyz[chosen], base[chosen]
        if len(xyz) > 0:
            return _isotropic(xyz, base, start, sh_degree)
    xyz, base = _random_points(scene, options, start.max_gaussians, generator)
    return _isotropic(xyz, base, start, sh_degree)


def _random_points(
    scene: Surroundings, options: PointsInit | RandomInit, max_points: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Positions (N, 3) float64 uniform in a cube, and base colour coefficients (N, 3) just above mid grey (3DGS)."""
    count = min(options.num_random, max_points)
    center, half_extent = torch.zeros(3, dtype=torch.float64, device="cpu"), options.half_extent
    if options.kind != "random" and not scene.around_origin:
        center = torch.from_numpy(scene.camera_centers.mean(axis=0))
        half_extent = CUBE_PER_EXTENT * scene.extent
    unit = torch.rand((count, 3), generator=generator, dtype=torch.float64, device="cpu") * 2 - 1
    base = torch.rand((count, 3), generator=generator, dtype=torch.float64, device="cpu") / 255
    return unit * half_extent + center, base


def _isotropic(xyz: Tensor, base: Tensor, start: StartValues, sh_degree: int) -> Gaussians:
    n = len(xyz)
    log_scale = 0.5 * mean_squared_neighbour_distance(xyz).log() + math.log(start.scale_factor)
    sh = torch.zeros((n, num_sh_terms(sh_degree), 3), device="cpu")
    sh[:, 0] = base.float()
    return Gaussians(
        means=xyz.float(),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0], device="cpu").repeat(n, 1),
        log_scales=log_scale.float()[:, None].repeat(1, 3),
        logit_opacities=torch.full((n,), math.log(start.opacity / (1 - start.opacity)), device="cpu"),
        sh=sh,
    )


def mean_squared_neighbour_distance(xyz: Tensor) -> Tensor:
    """Return (N,) mean squared distance to the three nearest other points, at least 1e-7; ``xyz`` is (N, 3).

    With fewer than four points the mean is over those there are; a single point gets 1e-2.
    """
    from scipy.spatial import KDTree

    neighbours = min(3, len(xyz) - 1)
    if neighbours < 1:
        return torch.full((len(xyz),), 1e-2, dtype=torch.float64, device="cpu")
    points = xyz.double().numpy()
    distances, _ = KDTree(points).query(points, k=neighbours + 1)
    squared = torch.from_numpy(np.square(distances[:, 1:]).mean(axis=1))
    return squared.clamp_min(MIN_SQUARED_DISTANCE)
