"""Construction of trainers for all model kinds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from dyngs.capture.initial_points import create_initial_points
from dyngs.capture.inspection import check_before_training
from dyngs.config import Config, PointsInit, RandomInit
from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.core.errors import log_info, log_warning
from dyngs.data.capture import Capture
from dyngs.data.loader import ImageLoader, default_decoding_threads
from dyngs.data.read import read_capture, require_images
from dyngs.data.scene_space import cube_half_side, cube_mismatch_reason, scene_extent
from dyngs.data.times import evenly_spaced
from dyngs.gaussians.initialization import InitialGaussians
from dyngs.gaussians.model import GaussianModel
from dyngs.models.kind import HasMotion, StartContext, find_kind
from dyngs.models.model import Correction, Loss
from dyngs.models.views import (
    background_colour,
    background_coloured_fraction,
    resolve_background,
    training_cameras,
    training_times,
)
from dyngs.ops.device import select_device
from dyngs.training.corrections.camera_refinement import CameraRefinement
from dyngs.training.corrections.exposure import ViewExposures
from dyngs.training.corrections.robust import RobustMasks
from dyngs.training.losses import ImageLoss, SilhouetteLoss
from dyngs.training.priors import PriorLosses, load_priors
from dyngs.training.trainer import Trainer, TrainerParts

GaussianTrainer = Trainer[GaussianModel]  # Trainer of a scene of Gaussians

# Fraction of opaque pixels that resemble the background, from which alpha is weighted fully from
# the start: only silhouettes show such moving objects.
MANY_ALIKE = 0.05
# Fraction of train.alpha_weight for other moving scenes until their motion is learned
EARLY_OPACITY = 0.2
# Fraction of the run after which train.alpha_weight counts fully (measured)
FULL_OPACITY_FROM = 0.6
ALIKE_IMAGES = 12  # Number of images in which colours are compared with the background


def build_trainer(
    config: Config,
    capture: Capture | None = None,
    *,
    restored: bool = False,
    images: ImageLoader | None = None,
    first: InitialGaussians | None = None,
    uncapped: Config | None = None,
    added_losses: Sequence[Loss] = (),
) -> Trainer[Any]:
    """Return the trainer of a scene with an initialised, untrained model.

    Args:
        capture: with initial points. None reads it.
        restored: a checkpoint will be restored, so initial points are not needed.
        images: training images of another trainer of the same capture. None opens them.
        first: Gaussians to start from. None initialises them as in ``config.init``.
        uncapped: config without the limit on Gaussians, used for initialisation. None uses
            ``config``.
        added_losses: losses of the user.
    """
    if capture is None:
        capture = read_capture(config.data)
        if not restored:
            capture = add_initial_points(require_images(capture), config)
    generator = torch.Generator().manual_seed(config.run.seed)
    if images is None:
        images = ImageLoader(
            capture.splits["train"],
            config.data,
            with_maps=True,
            decoding_threads=default_decoding_threads(),
        )
    priors = PriorLosses()
    kind = find_kind(config.model)
    if "train.priors" in kind.uses:
        moves = isinstance(kind, HasMotion) and len(set(training_times(capture))) > 1
        priors = load_priors(config, capture, images.views, moves=moves)
    if not priors.masks:
        images = images.without_motion_masks()
    background = resolve_background(config, capture)
    extent = scene_extent(capture.splits["train"])
    early = _early_alpha_fraction(config, capture, images, background)

    def parts(config: Config) -> TrainerParts:
        start = StartContext(
            config, uncapped or config, capture, images, background, extent, generator, first
        )
        model = kind.start(start)
        steps = config.train.steps
        views = images.views
        refinements: list[Correction] = []
        if config.camera.refine == "always":
            refinement = CameraRefinement(views, extent, steps)
            correct_cameras = refinement.corrections.correct_cameras
            images.camera_correction = lambda index, cameras: correct_cameras(views[index], cameras)
            refinements = [refinement]
        masks: list[Correction] = []
        may_mask = "train.robust" in kind.uses and not isinstance(kind, HasMotion)
        if config.train.robust == "always" and may_mask:
            cameras = training_cameras(views, config.data)
            masks = [RobustMasks(images, cameras, steps, images.camera_correction)]
        exposures: list[ViewExposures] = []
        if config.train.exposure == "always":
            exposures = [ViewExposures(len(images), steps, images)]
        losses = [
            model.colour_loss or ImageLoss(config.train.ssim_weight),
            SilhouetteLoss(config.train.alpha_weight, early, FULL_OPACITY_FROM * steps),
            *exposures,
            priors,
            *added_losses,
        ]
        return TrainerParts(model, losses, [*masks, *exposures, *refinements])

    return Trainer(
        config=config,
        build_parts=parts,
        capture=capture,
        images=images,
        background=background,
        extent=extent,
        generator=generator,
        start_message=priors.message,
        device=select_device(config.run.device),
    )


def add_initial_points(
    capture: Capture,
    config: Config,
    *,
    log_messages: bool = True,
    on_progress: ProgressCallback = ignore_progress,
) -> Capture:
    """Return ``capture`` with initial points, if the model kind needs them."""
    messages: list[str] = []
    warnings: list[str] = []
    if "init" in find_kind(config.model).uses:
        init = config.init
        if isinstance(init, PointsInit):
            capture, messages = create_initial_points(capture, config.data, init, on_progress)
        elif isinstance(init, RandomInit):
            views = capture.splits["train"]
            why = cube_mismatch_reason(
                views, cube_half_side(init.half_extent, views, capture.world_scale)
            )
            if why is not None:
                warnings.append(
                    f"init.kind=random: points are drawn around the origin, but {why}; use auto"
                )
    if log_messages:
        for message in messages:
            log_info(message)
        for warning in [*warnings, *check_before_training(capture)]:
            log_warning(warning)
    return capture


def _early_alpha_fraction(
    config: Config, capture: Capture, images: ImageLoader, background: str
) -> float:
    """Return the fraction of train.alpha_weight that applies until motion is learned.

    It depends on the capture alone, so a dynamic model starts exactly like a static one.
    """
    is_static = len(set(training_times(capture))) < 2
    if (
        is_static
        or not capture.has_alpha
        or config.train.alpha_weight == 0
        or background == "random"
    ):
        return 1.0
    shown = (images[i] for i in evenly_spaced(len(images), ALIKE_IMAGES))
    alike = background_coloured_fraction(shown, background_colour(background))
    return 1.0 if alike is None or alike >= MANY_ALIKE else EARLY_OPACITY
