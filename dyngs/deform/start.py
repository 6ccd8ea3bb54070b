"""Creation and restoration of dynamic models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.data.capture import View
from dyngs.data.times import evenly_spaced
from dyngs.deform.bodies.paths import FrameStack, order_moving_camera, render_frame_stack
from dyngs.deform.bodies.rigid_bodies import angles_deg
from dyngs.deform.fixed_cameras import FixedCameraClip, build_fixed_camera_clip
from dyngs.deform.keys import ControlNodesField, DynamicModel
from dyngs.deform.kind import DYNAMIC, RATE_FACTOR
from dyngs.deform.scene import DynamicScene
from dyngs.deform.schedule import deform_schedule
from dyngs.deform.static_errors import (
    StaticErrors,
    group_fixed_cameras,
    select_comparison_views,
    static_errors,
)
from dyngs.deform.training import SURELY_MOVING, DynamicTraining, TrainingViews
from dyngs.gaussians import Gaussians
from dyngs.gaussians.colour.training import ColourTraining
from dyngs.gaussians.initialization import (
    build_colour_training,
    build_densifier,
    build_filter_update,
    load_or_create_gaussians,
)
from dyngs.gaussians.model import GaussianModel, training_options
from dyngs.gaussians.rendering import Shader
from dyngs.gaussians.scene import restore_appearance
from dyngs.gaussians.schedule import rate_schedule
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import StartContext
from dyngs.models.schedule import image_divisor
from dyngs.models.views import evaluation_background, training_cameras, training_times

CLIP_ANGLE = 10.0  # largest median angle, degrees, between successive cameras of a clip
MAX_FIXED_CAMERAS = 12  # most fixed cameras in which motion is searched
MAX_SEARCHED_IMAGES = 150  # most images of a moving camera in which rigid bodies are searched
# Training steps per searched image, because the search takes as long as ten steps.
STEPS_PER_IMAGE = 50
SECONDS_PER_IMAGE = 3.0  # seconds of ``train.minutes`` per searched image


def start(run: StartContext) -> GaussianModel:
    """Create the model of a dynamic scene before its first step.

    Raises DyngsError if the images have no times.
    """
    model = run.config.model
    assert isinstance(model, DynamicModel)
    problem = DYNAMIC.refusal(run.capture)
    if problem is not None:
        raise DyngsError(f"{run.config.data.root}: {problem}")
    if isinstance(model.deform, ControlNodesField):
        turns_slowly = is_clip(run.capture.splits["train"])
        deform = model.deform.resolve_nodes(turns_slowly)
        model = model.model_copy(update={"deform": deform})
        if turns_slowly and run.config.optim.rate_factor is None:
            optim = run.config.optim.model_copy(update={"rate_factor": RATE_FACTOR})
            run = replace(run, config=run.config.model_copy(update={"optim": optim}))
    gaussians = load_or_create_gaussians(run)
    colours = build_colour_training(run, gaussians, uses_time=True)
    schedule = deform_schedule(model, rate_schedule(run.config))
    views = _training_views(run, model, colours)
    training = DynamicTraining(model, schedule, views, build_filter_update(run), run.generator)
    return GaussianModel(
        run, training.first_scene(gaussians), training, build_densifier(run), colours
    )


def is_clip(views: Sequence[View]) -> bool:
    """Return whether the views come from one camera that turns slowly, by the median angle between
    successive poses."""
    order = order_moving_camera(views)
    if order is None or len(order) < 2:
        return False
    rotations = np.stack([views[i].cam_from_world[:3, :3] for i in order])
    angles = angles_deg(rotations[1:] @ rotations[:-1].swapaxes(1, 2))
    return float(np.median(angles)) < CLIP_ANGLE


def restore(model: DynamicModel, checkpoint: Checkpoint) -> DynamicScene:
    """Return the scene in a checkpoint."""
    scene = DynamicScene.from_state(
        model, Gaussians.stored(checkpoint.part("gaussians")), checkpoint.part("model")
    )
    return restore_appearance(scene, model, checkpoint)


def _training_views(
    run: StartContext, model: DynamicModel, colours: ColourTraining
) -> TrainingViews:
    config = run.config
    capture = run.capture
    images = run.images
    views = capture.splits["train"]
    _, background = evaluation_background(config.data.background, capture.has_alpha)
    divisor = image_divisor(config.train, deform_schedule(model, rate_schedule(config)).coarse_end)
    looked_at = select_comparison_views(views)
    options = training_options(run)

    def shader(time: float) -> Shader | None:
        return None if colours.network is None else colours.network.shader(time)

    def errors_of(gaussians_at: Callable[[float], Gaussians]) -> StaticErrors:
        shown = [images.downscaled(i, divisor) for i in looked_at]
        mask_error = SURELY_MOVING * model.motion_threshold
        return static_errors(gaussians_at, shown, options, background, shader, mask_error)

    in_place = group_fixed_cameras(views)

    def fixed_clips() -> list[FixedCameraClip]:
        used = [in_place[i] for i in evenly_spaced(len(in_place), MAX_FIXED_CAMERAS)]
        total = sum(map(len, used))
        return [
            build_fixed_camera_clip((images[i] for i in seen), background, total) for seen in used
        ]

    def frame_stack(static: Gaussians) -> FrameStack | None:
        order = order_moving_camera(views)
        limit = min(MAX_SEARCHED_IMAGES, rate_schedule(config).steps // STEPS_PER_IMAGE)
        if config.train.minutes is not None:
            limit = min(limit, int(60 * config.train.minutes / SECONDS_PER_IMAGE))
        if order is None or limit == 0 or len(set(images.sizes)) > 1:
            return None
        used = (images[order[i]] for i in evenly_spaced(len(order), limit))
        return render_frame_stack(used, static, options, background, shader)

    return TrainingViews(
        training_times(capture),
        training_cameras(views, config.data),
        run.extent,
        errors_of,
        has_fixed_cameras=bool(in_place),
        fixed_clips=fixed_clips,
        frame_stack=frame_stack,
    )
