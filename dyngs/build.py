"""From a configuration to a trainer that is ready for its first step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch

from dyngs.budget.limits import within_cap
from dyngs.camera import Cameras
from dyngs.colour.colours import Colours, NetworkColours
from dyngs.colour.network import box_around
from dyngs.colour.thrift import ThriftyColours
from dyngs.config import (
    AutoColour,
    Config,
    DataConfig,
    DefaultStrategy,
    DynamicModel,
    FixedStrategy,
    HumanModel,
    McmcStrategy,
    NetworkColour,
    PointsInit,
)
from dyngs.data.capture import Capture, View
from dyngs.data.frame_selection import evenly_spaced
from dyngs.data.geometry.intrinsics import scaled_intrinsics
from dyngs.data.loader import Picture, PictureLoader
from dyngs.data.pictures.images import target_size
from dyngs.data.prepare.triangulate import triangulated_points, views_of_a_moment
from dyngs.data.read import read_capture
from dyngs.deform.model import DynamicScene, Surroundings4D
from dyngs.deform.residual import Residuals, cameras_in_place, residuals_of, views_to_compare
from dyngs.errors import DyngsError
from dyngs.evaluate.report import render_options
from dyngs.gaussians import Gaussians
from dyngs.human.avatar.anchors import texel_gaussians
from dyngs.human.avatar.model import HumanScene, Subject, first_look
from dyngs.human.avatar.posing import Skeleton, pose_blend_shapes
from dyngs.human.motion.captured import captured_motion
from dyngs.human.template.atlas import atlas_texels
from dyngs.human.template.load import load_template, rest_shape
from dyngs.rendering import RenderOptions
from dyngs.static.densify import DefaultDensifier, Densifier
from dyngs.static.fixed import FixedDensifier
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
    rates_of,
)
from dyngs.train.step import Model, Trainer

AROUND_ORIGIN = ("blender", "body_json")
"""Formats whose scenes lie around the origin by convention."""
FIRST_VIEWS = 50
"""Pictures that say what a person looks like before training."""


def assemble(config: Config, *, restored: bool = False) -> Trainer:
    """The trainer of a configuration: capture read, Gaussians initialised, nothing trained.

    Args:
        config: of a run.
        restored: a checkpoint will be, so that it does not matter where Gaussians begin: no points are triangulated.

    Raises:
        DyngsError: a capture that cannot be read, a budget that is too small.
    """
    capture = read_capture(config.data)
    if not restored:
        capture = with_points(capture, config)
    start = StartValues.for_strategy(config.strategy)
    config = within_cap(config, len(set(training_times(capture))))
    scene = surroundings(capture)
    generator = torch.Generator().manual_seed(config.run.seed)
    pictures = PictureLoader(capture.splits["train"], config.data)
    if isinstance(config.model, HumanModel):
        gaussians, model = human_model(config, capture, pictures)
        colours = _colours(config, capture, gaussians, generator)
    else:
        gaussians = initial_gaussians(scene, config.init, start, stored_sh_degree(config), generator)
        colours = _colours(config, capture, gaussians, generator)
        model = _model(config, capture, pictures, colours, generator)
    background = resolved_background(config, capture)
    x, y, z = (float(value) for value in capture.world_offset)
    return Trainer(
        config=config,
        model=model,
        optimizer=GaussianOptimizer(gaussians, config.optim),
        densifier=_densifier(config, background, scene.extent),
        colours=colours,
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
    model, sh_degree = config.model, stored_sh_degree(config)
    if not isinstance(model, HumanModel) or capture.body is None:
        raise DyngsError(f"{capture.root}: has no body parameters, which model.kind=human needs; see docs/human.md")
    if sh_degree > 1:
        raise DyngsError(f"model.sh_degree={sh_degree}: colours of a person turn with it up to 1; give 0 or 1")
    given, body = capture.body["train"], load_template(model)
    vertices, joints = rest_shape(body, torch.from_numpy(given.betas).float())
    texels = atlas_texels(body, model.resolution, vertices)
    gaussians, anchors = texel_gaussians(texels, sorted(set(model.scaffold_heights)), sh_degree)
    filmed = captured_motion(capture.root, given, capture.splits["train"], joints)
    subject = Subject(Skeleton(joints, body.parents), anchors, filmed, pose_blend_shapes(body))
    gaussians, subject = first_look(gaussians, texels, subject, _first_pictures(pictures), model.min_silhouette_share)
    return gaussians, HumanScene(model, subject, rates_of(config))


def stored_sh_degree(config: Config) -> int:
    """Degree of the harmonics that training begins with: 0 where a network gives the colours."""
    return 0 if isinstance(config.colour, NetworkColour) else config.model.sh_degree


def with_points(capture: Capture, config: Config) -> Capture:
    """``capture``, with triangulated points if it has none and enough cameras show one moment.

    Not where it is published custom to begin with random points: the still scenes of Blender, around the origin.
    """
    init, views = config.init, capture.splits["train"]
    custom = capture.format in AROUND_ORIGIN and all(view.time is None for view in views)
    if not isinstance(init, PointsInit) or isinstance(config.model, HumanModel) or capture.points is not None or custom:
        return capture
    moment = views_of_a_moment(views, init.triangulate)
    return capture.replace(points=triangulated_points(moment, config.data))


def surroundings(capture: Capture) -> Surroundings:
    """What initialisation needs to know of a capture."""
    poses = np.stack([view.cam_from_world for view in capture.splits["train"]])
    centers = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    points = capture.points
    return Surroundings(
        camera_centers=centers,
        points=None if points is None else points.xyz,
        points_rgb=None if points is None else points.rgb,
        around_origin=capture.format in AROUND_ORIGIN,
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
    config: Config, capture: Capture, pictures: PictureLoader, colours: Colours, generator: torch.Generator
) -> Model:
    """The model asked for; a static one where there are no times for anything to move in."""
    model, steps = config.model, config.train.steps
    cameras = training_cameras(capture.splits["train"], config.data)
    still = StaticScene(cameras, filter_steps(config.strategy, steps)) if model.filter_3d else StaticScene()
    times = training_times(capture)
    if not isinstance(model, DynamicModel) or len(set(times)) < 2:
        return still
    _, colour = evaluation_background(config.data.background, capture.has_alpha)
    schedule = deform_schedule(model, rates_of(config))
    divisor = picture_divisor(config.train, schedule.fine)

    looked_at = views_to_compare(capture.splits["train"])

    def residuals(gaussians_at: Callable[[float], Gaussians]) -> Residuals:
        shown = [pictures[i].shrunk(divisor) for i in looked_at]
        return residuals_of(gaussians_at, shown, _render_options(config), colour, lambda t: colours.shader(t, None))

    stay = bool(cameras_in_place(capture.splits["train"]))
    extent = surroundings(capture).extent
    around = Surroundings4D(times, cameras, extent, residuals, cameras_stay=stay)
    return DynamicScene(model, schedule, around, still, generator)


def _colours(config: Config, capture: Capture, gaussians: Gaussians, generator: torch.Generator) -> Colours:
    """The kind of colours asked for. A person's do not depend on time, which would mean nothing in another motion."""
    colour = config.colour
    if isinstance(colour, NetworkColour):
        sees_time = isinstance(config.model, DynamicModel) and len(set(training_times(capture))) > 1
        box = box_around(gaussians.means)
        return NetworkColours(colour, config.train.steps, box, generator, sees_time=sees_time)
    if isinstance(colour, AutoColour):
        return ThriftyColours(colour, config.train.steps, len(capture.splits["train"]))
    return Colours(colour)


def _first_pictures(pictures: PictureLoader) -> Iterator[Picture]:
    """At most ``FIRST_VIEWS`` of the pictures, evenly chosen."""
    return (pictures[i] for i in evenly_spaced(len(pictures), FIRST_VIEWS))


def _densifier(config: Config, background: str, extent: float) -> Densifier:
    strategy, steps = config.strategy, config.train.steps
    if isinstance(strategy, FixedStrategy):
        return FixedDensifier()
    schedule = densify_schedule(strategy, steps, background == "white")
    if isinstance(strategy, McmcStrategy):
        return McmcDensifier(strategy, schedule, growth_per_change(strategy, steps))
    threshold = grad_threshold(strategy, steps)
    return DefaultDensifier(strategy.model_copy(update={"grad_threshold": threshold}), schedule, extent)


def _render_options(config: Config) -> RenderOptions:
    strategy = config.strategy
    absgrad = isinstance(strategy, DefaultStrategy) and strategy.absgrad
    return replace(render_options(config.model), absgrad=absgrad, nonfinite="trust")
