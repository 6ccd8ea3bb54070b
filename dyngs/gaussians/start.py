"""What all models of Gaussians begin with: colours, a strategy, a 3D filter."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import assert_never

from dyngs.config import (
    AutoColour,
    DefaultStrategy,
    FixedStrategy,
    McmcStrategy,
    NetworkColour,
    ShColour,
)
from dyngs.gaussians import Gaussians
from dyngs.gaussians.colour.network import box_around
from dyngs.gaussians.colour.training import AutoTraining, ColourTraining, NetworkTraining
from dyngs.gaussians.densify import DefaultDensifier, Densifier
from dyngs.gaussians.filters import FilterUpdate
from dyngs.gaussians.init import StartValues, initial_gaussians, surroundings
from dyngs.gaussians.mcmc import McmcDensifier
from dyngs.gaussians.schedule import (
    densify_schedule,
    filter_steps,
    grad_threshold,
    growth_per_change,
)
from dyngs.models.kind import RunStart
from dyngs.models.views import training_cameras


@dataclass(frozen=True)
class FirstGaussians:
    """Gaussians of a scene that a run goes on from, and which of them (N,) bool stay as they are;
    None: none."""

    gaussians: Gaussians
    frozen: Tensor | None = None


def first_gaussians(run: RunStart) -> Gaussians:
    """Return the Gaussians of the scene to go on from, at the points of the capture, or at
    random."""
    if run.first is not None:
        return run.first.gaussians
    config = run.config
    start = StartValues.for_strategy(run.asked.strategy)
    where = surroundings(run.capture)
    return initial_gaussians(where, config.init, start, config.stored_sh_degree, run.generator)


def colours_of(run: RunStart, gaussians: Gaussians, *, sees_time: bool) -> ColourTraining:
    """Return how colours are trained."""
    colour = run.config.colour
    steps = run.config.train.steps
    match colour:
        case ShColour():
            return ColourTraining(colour)
        case AutoColour():
            return AutoTraining(colour, steps, len(run.capture.splits["train"]))
        case NetworkColour():
            box = box_around(gaussians.means)
            return NetworkTraining(colour, steps, box, run.generator, sees_time=sees_time)
        case _:
            assert_never(colour)


def densifier_of(run: RunStart) -> Densifier:
    """Return the strategy of the run."""
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
            center = torch.from_numpy(surroundings(run.capture).camera_centers.mean(axis=0)).float()
            return DefaultDensifier(
                options, densify_schedule(strategy, steps, on_white), run.extent, center
            )
        case FixedStrategy():
            return Densifier()
        case _:
            assert_never(strategy)


def filter_update(run: RunStart) -> FilterUpdate:
    """Return when the 3D filter of the model is computed anew."""
    config = run.config
    cameras = (
        training_cameras(run.capture.splits["train"], config.data) if config.model.filter_3d else []
    )
    return FilterUpdate(cameras, filter_steps(config.strategy, config.train.steps))
