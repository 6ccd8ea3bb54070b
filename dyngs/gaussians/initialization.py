"""Initial Gaussians, colour training, densification strategy and 3D filter of a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from typing_extensions import assert_never

from dyngs.capture.initial_points import AROUND_ORIGIN
from dyngs.config import (
    AutoColour,
    DefaultStrategy,
    FixedStrategy,
    McmcStrategy,
    NetworkColour,
    PointsInit,
    RandomInit,
    SceneInit,
    ShColour,
    Strategy,
)
from dyngs.core.conventions import SH_C0, num_sh_terms
from dyngs.data.capture import Capture, View
from dyngs.data.scene_space import (
    MIN_VIEWS,
    camera_centers,
    cube_half_side,
    cube_mismatch_reason,
    sample_points_in_frusta,
)
from dyngs.gaussians import Gaussians
from dyngs.gaussians.colour.network import robust_bounding_box
from dyngs.gaussians.colour.training import AutoTraining, ColourTraining, NetworkTraining
from dyngs.gaussians.densify import DefaultDensifier, Densifier, McmcDensifier
from dyngs.gaussians.filters import FilterUpdate
from dyngs.gaussians.schedule import (
    densify_schedule,
    filter_steps,
    grad_threshold,
    growth_per_change,
)
from dyngs.models.kind import StartContext
from dyngs.models.views import training_cameras

START_OPACITY = 0.1
# Initial opacity, and scale relative to the neighbour distance, of 3DGS-MCMC.
MCMC_OPACITY, MCMC_SCALE = 0.5, 0.1
MIN_SQUARED_DISTANCE = 1e-7
# Candidates per random point that is sampled from the view frusta.
CANDIDATES_PER_POINT = 4


@dataclass(frozen=True)
class InitialValues:
    """Initial scales and opacities of a strategy."""

    opacity: float = START_OPACITY  # in (0, 1)
    scale_factor: float = 1.0  # multiplies the distance to the nearest neighbours
    max_gaussians: int = 3_000_000  # more points are subsampled at random

    @staticmethod
    def for_strategy(strategy: Strategy) -> InitialValues:
        """Return the published initial values of ``strategy`` (3DGS-MCMC: more opaque and
        smaller)."""
        match strategy:
            case McmcStrategy():
                return InitialValues(MCMC_OPACITY, MCMC_SCALE, strategy.max_gaussians)
            case DefaultStrategy():
                return InitialValues(max_gaussians=strategy.max_gaussians)
            case FixedStrategy():
                return InitialValues()


def initial_gaussians(
    capture: Capture,
    options: PointsInit | RandomInit | SceneInit,
    start: InitialValues,
    sh_degree: int,
    generator: torch.Generator,
) -> Gaussians:
    """Create isotropic Gaussians whose scale is the distance to their three nearest neighbours.

    ``RandomInit`` samples a cube around the origin. ``PointsInit`` uses the finite sparse points.
    Without points it samples that cube, if the format places scenes around the origin, else the
    view frusta.
    """
    points = capture.points
    if options.kind != "random" and points is not None:
        finite = np.isfinite(points.xyz).all(axis=1)
        xyz = torch.from_numpy(points.xyz[finite].astype(np.float64))
        base = (torch.from_numpy(points.rgb[finite].astype(np.float64)) / 255 - 0.5) / SH_C0
        if len(xyz) > start.max_gaussians:
            chosen = (
                torch.randperm(len(xyz), generator=generator, device="cpu")[: start.max_gaussians]
                .sort()
                .values
            )
            xyz = xyz[chosen]
            base = base[chosen]
        if len(xyz) > 0:
            return _create_isotropic(xyz, base, start, sh_degree)
    xyz, base = _random_points(capture, options, start.max_gaussians, generator)
    return _create_isotropic(xyz, base, start, sh_degree)


def _random_points(
    capture: Capture,
    options: PointsInit | RandomInit | SceneInit,
    max_points: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Sample positions (N, 3) float64 and base colour coefficients (N, 3) just above mid grey
    (3DGS)."""
    count = min(options.num_random, max_points)
    views = capture.splits["train"]
    half_extent = cube_half_side(options.half_extent, views, capture.world_scale)
    # by the convention of its format the scene lies around the origin
    around_origin = capture.format in AROUND_ORIGIN
    if options.kind == "random" or (
        around_origin and cube_mismatch_reason(views, half_extent) is None
    ):
        xyz = (
            torch.rand((count, 3), generator=generator, dtype=torch.float64, device="cpu") * 2 - 1
        ) * half_extent
    else:
        xyz = _sample_frusta(views, count, generator)
    return xyz, torch.rand((count, 3), generator=generator, dtype=torch.float64, device="cpu") / 255


def _sample_frusta(views: Sequence[View], count: int, generator: torch.Generator) -> Tensor:
    """Sample ``count`` points (N, 3) float64 from the view frusta, see ``sample_points_in_frusta``.

    The probability of a candidate is proportional to the square of the number of views that see
    it. Candidates seen by fewer than ``MIN_VIEWS`` views come last. Most points thus lie where
    most cameras look, and some wherever depth can be triangulated.
    """
    unit = torch.rand(
        (CANDIDATES_PER_POINT * count, 5), generator=generator, dtype=torch.float64, device="cpu"
    ).numpy()
    xyz, seen = sample_points_in_frusta(views, unit[:, :4])
    # The largest u^(1 / weight) are a weighted sample without replacement (Efraimidis and Spirakis
    # 2006).
    order = np.log(np.maximum(unit[:, 4], 1e-300)) / np.maximum(seen, 1) ** 2
    order[seen < min(MIN_VIEWS, len(views))] -= 1e6
    return torch.from_numpy(xyz[np.sort(np.argsort(-order, kind="stable")[:count])])


def _create_isotropic(xyz: Tensor, base: Tensor, start: InitialValues, sh_degree: int) -> Gaussians:
    log_scale = 0.5 * mean_squared_neighbour_distance(xyz).log() + math.log(start.scale_factor)
    logit = math.log(start.opacity / (1 - start.opacity))
    sizes = log_scale.float()[:, None]
    return Gaussians.isotropic(xyz.float(), sizes, logit, base.float(), num_sh_terms(sh_degree))


def mean_squared_neighbour_distance(xyz: Tensor) -> Tensor:
    """Return the mean squared distance (N,) to the three nearest other points, at least 1e-7.

    ``xyz`` is (N, 3). With fewer than four points the mean is over the existing neighbours; a
    single point gets 1e-2.
    """
    from scipy.spatial import KDTree

    neighbours = min(3, len(xyz) - 1)
    if neighbours < 1:
        return torch.full((len(xyz),), 1e-2, dtype=torch.float64, device="cpu")
    points = xyz.double().numpy()
    distances, _ = KDTree(points).query(points, k=neighbours + 1)
    squared = torch.from_numpy(np.square(distances[:, 1:]).mean(axis=1))
    return squared.clamp_min(MIN_SQUARED_DISTANCE)


@dataclass(frozen=True)
class InitialGaussians:
    """Gaussians of an existing scene that a run continues from.

    ``frozen`` (N,) bool: Gaussians that are frozen during training; None: none.
    """

    gaussians: Gaussians
    frozen: Tensor | None = None


def load_or_create_gaussians(run: StartContext) -> Gaussians:
    """Return the Gaussians of the scene that the run continues from, or new initial Gaussians."""
    if run.first is not None:
        return run.first.gaussians
    config = run.config
    start = InitialValues.for_strategy(run.uncapped.strategy)
    degree = config.stored_sh_degree
    return initial_gaussians(run.capture, config.init, start, degree, run.generator)


def build_colour_training(
    run: StartContext, gaussians: Gaussians, *, uses_time: bool
) -> ColourTraining:
    """Build the training of colours for ``colour.kind``."""
    colour = run.config.colour
    steps = run.config.train.steps
    match colour:
        case ShColour():
            return ColourTraining(colour)
        case AutoColour():
            return AutoTraining(colour, steps, len(run.capture.splits["train"]))
        case NetworkColour():
            box = robust_bounding_box(gaussians.means)
            return NetworkTraining(colour, steps, box, run.generator, uses_time=uses_time)
        case _:
            assert_never(colour)


def build_densifier(run: StartContext) -> Densifier:
    """Build the densification strategy."""
    strategy = run.config.strategy
    steps = run.config.train.steps
    on_white = run.background == "white"
    match strategy:
        case McmcStrategy():
            schedule = densify_schedule(strategy, steps, on_white)
            return McmcDensifier(strategy, schedule, growth_per_change(steps))
        case DefaultStrategy():
            options = strategy.model_copy(
                update={"grad_threshold": grad_threshold(strategy, steps)}
            )
            centers = camera_centers(run.capture.splits["train"])
            center = torch.from_numpy(centers.mean(axis=0)).float()
            schedule = replace(
                densify_schedule(strategy, steps, on_white),
                prunes_to_end=run.config.colour.opacity_entropy > 0,
            )
            return DefaultDensifier(options, schedule, run.extent, center)
        case FixedStrategy():
            return Densifier()
        case _:
            assert_never(strategy)


def build_filter_update(run: StartContext) -> FilterUpdate:
    """Build the schedule of the 3D filter."""
    config = run.config
    cameras = (
        training_cameras(run.capture.splits["train"], config.data) if config.model.filter_3d else []
    )
    return FilterUpdate(cameras, filter_steps(config.strategy, config.train.steps))
