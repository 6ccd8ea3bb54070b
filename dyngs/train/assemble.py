"""From a configuration to a trainer that is ready for its first step."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.config import Config, DataConfig, DynamicModel, HumanModel, McmcStrategy
from dyngs.data.capture import Capture, View
from dyngs.data.images import target_size
from dyngs.data.intrinsics import scaled_intrinsics
from dyngs.data.loader import Picture, PictureLoader
from dyngs.data.read import read_capture
from dyngs.deform.model import DynamicScene, Surroundings4D
from dyngs.deform.residual import residual_scores
from dyngs.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.human.avatar import Skeleton, first_gaussians
from dyngs.human.clips import footage
from dyngs.human.model import HumanScene, Subject, first_look
from dyngs.human.person import rest_shape, template
from dyngs.human.uv import texels_of
from dyngs.rendering import RenderOptions
from dyngs.static.densify import DefaultDensifier, Densifier
from dyngs.static.init import StartValues, Surroundings, initial_gaussians
from dyngs.static.mcmc import McmcDensifier
from dyngs.static.model import StaticScene
from dyngs.static.optimizer import GaussianOptimizer
from dyngs.train.background import evaluation_background
from dyngs.train.sampler import ViewSampler
from dyngs.train.schedule import (
    deform_schedule,
    densify_schedule,
    filter_steps,
    grad_threshold,
    growth_per_change,
    picture_divisor,
)
from dyngs.train.step import Model, Trainer

RESIDUAL_VIEWS = 50
"""Pictures that are looked at for what moves."""


def assemble(config: Config) -> Trainer:
    """The trainer of a configuration: capture read, Gaussians initialised, nothing trained.

    Raises:
        DyngsError: a capture that cannot be read.
    """
    capture = read_capture(config.data)
    scene = surroundings(capture)
    generator = torch.Generator().manual_seed(config.run.seed)
    start = StartValues.for_strategy(config.strategy)
    pictures = PictureLoader(capture.splits["train"], config.data)
    if isinstance(config.model, HumanModel):
        gaussians, model = human_model(config, capture, pictures)
    else:
        gaussians = initial_gaussians(scene, config.init, start, config.model.sh_degree, generator)
        model = _model(config, capture, pictures, scene.extent, generator)
    background = resolved_background(config, capture)
    x, y, z = (float(value) for value in capture.world_offset)
    return Trainer(
        config=config,
        model=model,
        optimizer=GaussianOptimizer(gaussians, config.optim),
        densifier=_densifier(config, background, scene.extent),
        pictures=pictures,
        sampler=ViewSampler(len(pictures)),
        options=_render_options(config),
        background=background,
        extent=scene.extent,
        world_offset=(x, y, z),
        has_test_views=bool(capture.splits.get("test")),
        generator=generator,
    )


def human_model(config: Config, capture: Capture, pictures: PictureLoader) -> tuple[Gaussians, HumanScene]:
    """The first Gaussians of a person, and the model that poses them.

    Raises:
        DyngsError: a capture without body parameters, or a template that cannot be read.
    """
    model = config.model
    if not isinstance(model, HumanModel) or capture.body is None:
        raise DyngsError(f"{capture.root}: has no body parameters, which model.kind=human needs; see docs/human.md")
    if model.sh_degree > 1:
        raise DyngsError(f"model.sh_degree={model.sh_degree}: colours of a person turn with it up to 1; give 0 or 1")
    given, body = capture.body["train"], template(model)
    vertices, joints = rest_shape(body, torch.from_numpy(given.betas).float())
    texels = texels_of(body, model.resolution, vertices)
    gaussians, anchors = first_gaussians(texels, sorted(set(model.heights)), model.sh_degree)
    filmed = footage(capture.root, given, capture.splits["train"], joints)
    subject = Subject(Skeleton(joints, body.parents), anchors, filmed)
    gaussians, subject = first_look(gaussians, texels, subject, _spread(pictures, 1), model.carve)
    return gaussians, HumanScene(model, subject, config.train.steps)


def surroundings(capture: Capture) -> Surroundings:
    """What initialisation needs to know of a capture."""
    poses = np.stack([view.cam_from_world for view in capture.splits["train"]])
    centers = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    points = capture.points
    return Surroundings(
        camera_centers=centers,
        points=None if points is None else points.xyz,
        points_rgb=None if points is None else points.rgb,
        around_origin=capture.format in ("blender", "body_json"),
    )


def resolved_background(config: Config, capture: Capture) -> str:
    """White, black or random; "auto" is white where pictures have alpha, as 3DGS has it, and black otherwise."""
    if config.data.background == "auto":
        return "white" if capture.has_alpha else "black"
    return config.data.background


def training_cameras(views: Sequence[View], options: DataConfig) -> list[Cameras]:
    """The cameras of ``views`` as pictures of their training size, one each; no picture is read."""
    cameras = []
    for view in views:
        width, height = target_size(view.width, view.height, options.downscale, options.longest_side)
        intrinsics = scaled_intrinsics(view.intrinsics, width / view.width, height / view.height)
        pose = torch.from_numpy(view.cam_from_world).float()
        cameras.append(Cameras(pose[None], torch.from_numpy(intrinsics).float()[None], width, height))
    return cameras


def training_times(capture: Capture) -> tuple[float, ...]:
    """Times of the training views in [0, 1], ascending; empty without times."""
    return tuple(sorted(view.time for view in capture.splits["train"] if view.time is not None))


def _model(
    config: Config, capture: Capture, pictures: PictureLoader, extent: float, generator: torch.Generator
) -> Model:
    """The model asked for; a static one where there are no times for anything to move in."""
    model, steps = config.model, config.train.steps
    cameras = training_cameras(capture.splits["train"], config.data)
    still = StaticScene(cameras, filter_steps(config.strategy, steps)) if model.filter_3d else StaticScene()
    times = training_times(capture)
    if not isinstance(model, DynamicModel) or len(set(times)) < 2:
        return still
    _, colour = evaluation_background(config.data.background, capture.has_alpha)
    schedule = deform_schedule(model, steps)
    divisor = picture_divisor(config.train, schedule.fine)

    def residuals(gaussians: Gaussians) -> Tensor:
        return residual_scores(gaussians, _spread(pictures, divisor), _render_options(config), colour)

    surroundings = Surroundings4D(times, cameras, extent, residuals)
    return DynamicScene(model, schedule, surroundings, still, generator)


def _spread(pictures: PictureLoader, divisor: int) -> Iterator[Picture]:
    """At most ``RESIDUAL_VIEWS`` of the pictures, evenly chosen, with their sides divided by ``divisor``."""
    count = min(len(pictures), RESIDUAL_VIEWS)
    return (pictures[i * len(pictures) // count].shrunk(divisor) for i in range(count))


def _densifier(config: Config, background: str, extent: float) -> Densifier:
    strategy, steps = config.strategy, config.train.steps
    schedule = densify_schedule(strategy, steps, background == "white")
    if isinstance(strategy, McmcStrategy):
        return McmcDensifier(strategy, schedule, growth_per_change(strategy, steps))
    threshold = grad_threshold(strategy, steps)
    return DefaultDensifier(strategy.model_copy(update={"grad_threshold": threshold}), schedule, extent)


def _render_options(config: Config) -> RenderOptions:
    strategy, model = config.strategy, config.model
    absgrad = not isinstance(strategy, McmcStrategy) and strategy.absgrad
    return RenderOptions(
        near=model.near, eps2d=model.eps2d, mode=model.rasterize_mode, absgrad=absgrad, nonfinite="trust"
    )
