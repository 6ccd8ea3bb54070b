"""Trainers from a configuration, ready for the first step, and scenes from a checkpoint.

Here, and nowhere else, it is decided what each kind of model, colour and strategy is made of.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from typing_extensions import assert_never

from dyngs.capture.first_points import with_first_points
from dyngs.capture.inspection.scene_problems import before_training
from dyngs.config import (
    AutoColour,
    Config,
    DataConfig,
    DefaultStrategy,
    DynamicModel,
    FixedStrategy,
    HumanModel,
    HumanPredictorModel,
    McmcStrategy,
    NetworkColour,
    PointsInit,
    RandomInit,
    SceneModel,
    ShColour,
    StaticModel,
)
from dyngs.config.kinds import field_of, stored_sh_degree, uses_absgrad
from dyngs.data.ahead import usual_threads
from dyngs.data.capture import Capture
from dyngs.data.frame_selection import evenly_spaced
from dyngs.data.geometry.frusta import outside_of_cube
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.deform.compared_views import ComparedViews
from dyngs.deform.fixed_cameras.changes import Footage, footage_of
from dyngs.deform.given_masks import moving_fraction_of
from dyngs.deform.scene import DynamicScene
from dyngs.deform.still_error import StillErrors, cameras_in_place, still_errors, views_to_compare
from dyngs.deform.training import SURELY_MOVING, DynamicTraining, TrainingViews
from dyngs.errors import DyngsError, reading
from dyngs.gaussians import Gaussians
from dyngs.gaussians.colour.network import box_around, network_of
from dyngs.gaussians.colour.training import AutoTraining, ColourTraining, NetworkTraining
from dyngs.gaussians.rendering import RenderOptions, Shader
from dyngs.gaussians.scene import Scene, SceneTraining, render_options
from dyngs.human.avatar.fine_limbs import pixel_size, surface_gaussians, surface_texels
from dyngs.human.avatar.light import rest_normals
from dyngs.human.avatar.posing import Skeleton, pose_blend_shapes
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.avatar.subject import Subject, first_look
from dyngs.human.avatar.training import HumanTraining
from dyngs.human.motion.captured import captured_motion
from dyngs.human.template.load import load_template, rest_shape
from dyngs.ops.device import device_for
from dyngs.gaussians.densify import DefaultDensifier, Densifier
from dyngs.gaussians.densify import Densifier
from dyngs.gaussians.init import StartValues, initial_gaussians
from dyngs.gaussians.mcmc import McmcDensifier
from dyngs.gaussians.optimizer import GaussianOptimizer
from dyngs.static.scene import StaticScene
from dyngs.gaussians.filters import FilterUpdate
from dyngs.static.training import StaticTraining
from dyngs.models.views import IMAGES, AlphaWeight, background_colour, evaluation_background, measured_alpha_weight
from dyngs.training.corrections.camera_refinement import CameraRefinement
from dyngs.training.corrections.exposure import exposures_of
from dyngs.training.corrections.robust import RobustMasks
from dyngs.training.limits import within_cap
from dyngs.training.loop import Trainable
from dyngs.training.prediction import assemble_network
from dyngs.training.priors.find import used_priors
from dyngs.training.priors.used import UsedPriors
from dyngs.training.sampler import ViewSampler
from dyngs.deform.schedule import deform_schedule
from dyngs.gaussians.schedule import densify_schedule, filter_steps, grad_threshold, growth_per_change, rates_of
from dyngs.models.schedule import hold_out_until, image_divisor
from dyngs.models.checkpoint import OTHER_CONFIG, Checkpoint
from dyngs.training.trainer import Trainer
from dyngs.models.views import held_out_views, resolved_background, training_cameras, training_times
from dyngs.gaussians.init import surroundings

MAX_STANDING = 12
"""Cameras that stand still from which tracks are found, at most."""
_TOLD: set[tuple[Path, str]] = set()
"""Captures, and warnings about them that were told in this process."""
_FIRST_POINTS: dict[str, tuple[Capture, list[str]]] = {}
"""The last capture with its first points, and lines on them: a run and the small ones beside it begin with the same."""
FIRST_VIEWS = 50
"""Number of images from which a person's first colours are taken."""


@dataclass(frozen=True)
class Built:
    """The trainer of a configuration.

    Attributes:
        trainer: for the loop.
        scene_trainer: the same one where it trains a scene, which limits and pruning may change; None for a network.
    """

    trainer: Trainable
    scene_trainer: Trainer | None


def build(config: Config, *, restored: bool = False) -> Built:
    """Return the trainer of a configuration; see ``assemble`` for the arguments and errors."""
    match config.model:
        case HumanPredictorModel():
            return Built(assemble_network(config, config.model), None)
        case StaticModel() | DynamicModel() | HumanModel():
            trainer = assemble(config, restored=restored)
            return Built(trainer, trainer)
        case _:
            assert_never(config.model)


def assemble(config: Config, *, restored: bool = False) -> Trainer:
    """Return the trainer of a scene: capture read, Gaussians initialised, nothing trained.

    Args:
        config: of a run.
        restored: a checkpoint will be, so that it does not matter where Gaussians begin: no points are triangulated.

    Raises:
        DyngsError: a capture that cannot be read, a budget that is too small.
    """
    device = device_for(config.run.device)
    capture = read_capture(config.data)
    if not restored:
        capture = with_points(capture, config)
    start = StartValues.for_strategy(config.strategy)  # a run may begin with more Gaussians than it may end with
    config = within_cap(config, len(set(training_times(capture))))
    generator = torch.Generator().manual_seed(config.run.seed)
    views = capture.splits["train"]
    images = ImageLoader(views, config.data, with_maps=True, decoding_threads=usual_threads())
    priors = _priors(config, capture, images)
    if not priors.masks:
        images = images.without_motion_masks()
    first = _first(config, start, capture, images, generator)
    background, extent = resolved_background(config, capture), surroundings(capture).extent
    optimizer = GaussianOptimizer(first.scene.gaussians, config.optim)
    scene = replace(
        first.scene.with_gaussians(optimizer.parameters),
        colour=first.colours.network,
        options=render_options(config.model),
        background=evaluation_background(config.data.background, capture.has_alpha)[1],
    )
    x, y, z = (float(value) for value in capture.world_offset)
    refinement = _refinement(config, images, extent)  # before what asks the images for corrected cameras
    trainer = Trainer(
        config=config,
        scene=scene,
        training=first.training,
        optimizer=optimizer,
        densifier=_densifier(config, background, extent),
        colours=first.colours,
        images=images,
        sampler=ViewSampler(len(images)),
        options=_training_options(config),
        background=background,
        extent=extent,
        world_offset=(x, y, z),
        has_test_views=bool(capture.splits.get("test")),
        alpha=_alpha_weight(config, capture, images),
        generator=generator,
        held_out=held_out_views(capture.splits["train"], config.train.hold_out_every),
        held_out_until=hold_out_until(config.train),
        priors=priors,
        robust=_robust(config, capture, images),
        exposures=exposures_of(config.train, images),
        refinement=refinement,
    )
    trainer.place(device)
    return trainer


def _priors(config: Config, capture: Capture, images: ImageLoader) -> UsedPriors:
    """Return the priors of the capture that are used; none for people, whose poses say how they move."""
    match config.model:
        case StaticModel():
            return used_priors(config, capture, images, moves=False)
        case DynamicModel():
            return used_priors(config, capture, images, moves=len(set(training_times(capture))) > 1)
        case _:
            return UsedPriors()


def _robust(config: Config, capture: Capture, images: ImageLoader) -> RobustMasks | None:
    """Return the masks of what disagrees between views of a static scene, if they are asked for."""
    match config.model:
        case StaticModel() if config.train.robust == "always":
            cameras = training_cameras(capture.splits["train"], config.data)
            return RobustMasks(images, cameras, config.train.steps, images.corrected)
        case _:
            return None


def _refinement(config: Config, images: ImageLoader, size: float) -> CameraRefinement | None:
    """Return the refinement of the training cameras, if it is asked for; ``images`` have corrected cameras then."""
    if config.camera.refine != "always":
        return None
    refinement = CameraRefinement(images.views, size, config.train.steps)
    images.corrected = refinement.corrections.applied
    return refinement


def restored_scene(checkpoint: Checkpoint, model: SceneModel) -> Scene:
    """Return the scene of a checkpoint of ``model``.

    Raises:
        DyngsError: a tensor is missing, or is not as the model or the other tensors have it; names the file.
    """
    with reading(checkpoint.name, OTHER_CONFIG):
        try:
            gaussians, own = Gaussians.stored(checkpoint.part("gaussians")), checkpoint.part("model")
            colour = network_of(checkpoint.part("model.colour"))
            scene, background = _restored(model, gaussians, own), background_colour(checkpoint.info.background)
            return replace(scene, colour=colour, options=render_options(model), background=background)
        except KeyError as missing:
            raise DyngsError(f"{checkpoint.name} lacks {missing}; an earlier version wrote it: train anew") from None


def _restored(model: SceneModel, gaussians: Gaussians, own: dict[str, torch.Tensor]) -> Scene:
    match model:
        case StaticModel():
            return StaticScene.restored(gaussians, own)
        case DynamicModel():
            return DynamicScene.restored(model, gaussians, own)
        case HumanModel():
            return HumanScene.restored(model, gaussians, own)
        case HumanPredictorModel():
            raise ValueError("the run of a network has no scene")
        case _:
            raise TypeError(f"no kind of scene: {model!r}")


def with_points(capture: Capture, config: Config) -> Capture:
    """Return ``capture`` with the points that the scene begins with, see ``with_first_points``; people need none.

    What is suspicious about the capture, and where the points are from, is printed to stderr.
    """
    lines: list[str] = []
    match config.init, config.model:
        case PointsInit() as init, StaticModel() | DynamicModel():
            capture, lines = _with_known_points(capture, config.data, init)
        case RandomInit() as init, StaticModel() | DynamicModel():
            why = outside_of_cube(capture.splits["train"], init.half_extent)
            lines = [] if why is None else [f"init.kind=random draws points around the origin, but {why}: give auto"]
        case _:
            pass
    for line in [*lines, *before_training(capture)]:
        if (capture.root, line) not in _TOLD:  # a run may train a static model of the same capture, too
            print(f"dyngs: warning: {line}", file=sys.stderr, flush=True)
            _TOLD.add((capture.root, line))
    return capture


def _with_known_points(capture: Capture, options: DataConfig, init: PointsInit) -> tuple[Capture, list[str]]:
    """Return ``capture`` with its first points, and lines on them; found once for all sizes of its images."""
    read_as = options.model_dump_json(exclude={"downscale", "longest_side", "cache_mb"})
    key = f"{read_as} {init.triangulate} {init.half_extent}"
    if key not in _FIRST_POINTS:
        _FIRST_POINTS.clear()
        _FIRST_POINTS[key] = with_first_points(capture, options, init.triangulate, init.half_extent)
    known, lines = _FIRST_POINTS[key]
    return capture.replace(points=known.points, points_file=known.points_file), list(lines)


@dataclass(frozen=True)
class _First:
    """A scene before its first step, how it is trained, and how its colours are."""

    scene: Scene
    training: SceneTraining[Any]
    colours: ColourTraining


def _first(
    config: Config, start: StartValues, capture: Capture, images: ImageLoader, generator: torch.Generator
) -> _First:
    match config.model:
        case HumanModel():
            gaussians, subject = human_start(config, config.model, capture, images)
            colours = _colours(config, capture, gaussians, generator)
            filmed = capture.splits["train"]
            cameras = training_cameras(filmed, config.data)
            views = [(camera, view.frame or 0) for camera, view in zip(cameras, filmed, strict=True)]
            training = HumanTraining(config.model, subject.footage.frames, rates_of(config), views)
            lit = config.model.light and config.model.refine and colours.network is None
            normals = rest_normals(gaussians) if lit else None
            return _First(training.first_scene(gaussians, subject, normals), training, colours)
        case StaticModel() | DynamicModel():
            degree = stored_sh_degree(config)
            gaussians = initial_gaussians(surroundings(capture), config.init, start, degree, generator)
            colours = _colours(config, capture, gaussians, generator)
            training = _static_or_dynamic(config, config.model, capture, images, colours, generator)
            return _First(training.first_scene(gaussians), training, colours)
        case HumanPredictorModel():
            raise ValueError("a network is no scene")
        case _:
            assert_never(config.model)


def _static_or_dynamic(
    config: Config,
    model: StaticModel | DynamicModel,
    capture: Capture,
    images: ImageLoader,
    colours: ColourTraining,
    generator: torch.Generator,
) -> StaticTraining | DynamicTraining:
    """Return how the scene is trained: as a static one where there are no times for anything to move in."""
    cameras = training_cameras(capture.splits["train"], config.data)
    update = FilterUpdate(cameras if model.filter_3d else [], filter_steps(config.strategy, config.train.steps))
    match model:
        case DynamicModel() if len(set(training_times(capture))) > 1:
            views = _training_views(config, model, capture, images, colours)
            return DynamicTraining(model, deform_schedule(model, rates_of(config)), views, update, generator)
        case _:
            return StaticTraining(update)


def _alpha_weight(config: Config, capture: Capture, images: ImageLoader) -> AlphaWeight:
    """Return how much silhouettes count: what was asked for, or what moving things before this background need."""
    asked, background = config.train.alpha_weight, resolved_background(config, capture)
    if asked is not None:
        return AlphaWeight(asked)
    match config.model:
        case DynamicModel() if capture.has_alpha and background != "random" and len(set(training_times(capture))) > 1:
            shown = (images[i] for i in evenly_spaced(len(images), IMAGES))
            return measured_alpha_weight(shown, background_colour(background))
        case _:
            return AlphaWeight()


def human_start(config: Config, model: HumanModel, capture: Capture, images: ImageLoader) -> tuple[Gaussians, Subject]:
    """Return the first Gaussians of a person, and the person.

    Raises:
        DyngsError: a capture without body parameters, or a template that cannot be read.
    """
    sh_degree = stored_sh_degree(config)
    if capture.body is None:
        raise DyngsError(f"{capture.root}: has no body parameters, which model.kind=human needs; see docs/human.md")
    if sh_degree > 1:
        raise DyngsError(f"model.sh_degree={sh_degree}: colours of a person turn with it up to 1; give 0 or 1")
    given, body = capture.body["train"], load_template(model)
    vertices, joints = rest_shape(body, given)
    filmed = captured_motion(capture.root, given, capture.splits["train"], joints)
    cameras = training_cameras(capture.splits["train"], config.data) if model.fine_limbs else []
    parts = surface_texels(body, model.resolution, vertices, pixel_size(cameras, filmed.clip, joints[0]))
    gaussians, anchors, normals = surface_gaussians(parts, sorted(set(model.scaffold_heights)), sh_degree)
    subject = Subject(Skeleton(joints, body.parents), anchors, filmed, pose_blend_shapes(body))
    shown = (images[i] for i in evenly_spaced(len(images), FIRST_VIEWS))
    return first_look(gaussians, normals, subject, shown, model.min_silhouette_fraction)


def _training_views(
    config: Config, model: DynamicModel, capture: Capture, images: ImageLoader, colours: ColourTraining
) -> TrainingViews:
    """Return the properties of the capture that training a dynamic scene needs."""
    views = capture.splits["train"]
    _, background = evaluation_background(config.data.background, capture.has_alpha)
    divisor = image_divisor(config.train, deform_schedule(model, rates_of(config)).fine)
    looked_at, options = views_to_compare(views), _training_options(config)

    def shader(time: float) -> Shader | None:
        return None if colours.network is None else colours.network.shader(time)

    def errors_of(gaussians_at: Callable[[float], Gaussians]) -> StillErrors:
        shown = [images.shrunk(i, divisor) for i in looked_at]
        if any(image.moves is not None for image in shown):
            return moving_fraction_of(gaussians_at, shown, options, SURELY_MOVING * model.motion_threshold)
        return still_errors(gaussians_at, shown, options, background, shader)

    cameras, extent = training_cameras(views, config.data), surroundings(capture).extent
    in_place = cameras_in_place(views)

    def standing() -> list[Footage]:
        used = [in_place[i] for i in evenly_spaced(len(in_place), MAX_STANDING)]
        return [footage_of((images[i] for i in seen), background, sum(map(len, used))) for seen in used]

    left_out = held_out_views(views, config.train.hold_out_every)
    trained_on = [i for i in range(len(images)) if i not in left_out]
    held_out = ComparedViews(images, sorted(left_out), options, background, shader)
    return TrainingViews(
        training_times(capture),
        cameras,
        extent,
        errors_of,
        cameras_stay=bool(in_place),
        standing=standing,
        held_out=held_out.psnr if left_out else None,
        matched=replace(held_out, indices=trained_on),
    )


def _colours(config: Config, capture: Capture, gaussians: Gaussians, generator: torch.Generator) -> ColourTraining:
    """Return the kind of colours asked for. A person's do not see time, which would mean nothing in another motion."""
    match config.colour:
        case ShColour():
            return ColourTraining(config.colour)
        case AutoColour():
            return AutoTraining(config.colour, config.train.steps, len(capture.splits["train"]))
        case NetworkColour():
            sees_time = field_of(config) is not None and len(set(training_times(capture))) > 1
            box = box_around(gaussians.means)
            return NetworkTraining(config.colour, config.train.steps, box, generator, sees_time=sees_time)
        case _:
            assert_never(config.colour)


def _densifier(config: Config, background: str, extent: float) -> Densifier:
    strategy, steps, on_white = config.strategy, config.train.steps, background == "white"
    match strategy:
        case McmcStrategy():
            schedule = densify_schedule(strategy, steps, on_white)
            return McmcDensifier(strategy, schedule, growth_per_change(strategy, steps))
        case DefaultStrategy():
            options = strategy.model_copy(update={"grad_threshold": grad_threshold(strategy, steps)})
            return DefaultDensifier(options, densify_schedule(strategy, steps, on_white), extent)
        case FixedStrategy():
            return Densifier()
        case _:
            assert_never(strategy)


def _training_options(config: Config) -> RenderOptions:
    return replace(render_options(config.model), absgrad=uses_absgrad(config), nonfinite="trust")
