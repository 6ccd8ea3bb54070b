"""Trainers and scenes of every kind of model."""

from __future__ import annotations

from typing import Any

import torch

from dyngs.capture.initial_points import create_initial_points
from dyngs.capture.inspection import check_before_training
from dyngs.config import Config, PointsInit, RandomInit
from dyngs.core.errors import log_warning
from dyngs.data.capture import Capture
from dyngs.data.loader import ImageLoader, default_decoding_threads
from dyngs.data.read import read_capture, require_images
from dyngs.data.scene_space import cube_half_side, cube_mismatch_reason
from dyngs.data.times import evenly_spaced
from dyngs.gaussians.initialization import InitialGaussians, scene_geometry
from dyngs.gaussians.model import GaussianModel
from dyngs.models.kind import HasMotion, StartContext, find_kind
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
from dyngs.training.losses import ImageLoss, PenaltyLoss, RegularizerLoss, SilhouetteLoss
from dyngs.training.priors import PriorLosses, load_priors
from dyngs.training.trainer import Trainer, TrainerParts

GaussianTrainer = Trainer[GaussianModel]  # The trainer of a scene of Gaussians

MANY_ALIKE = 0.05
"""Fraction of the opaque pixels of the background's colour from which moving things are found by
their silhouettes."""
# fraction of train.alpha_weight before other moving things, until their motion is followed
EARLY_OPACITY = 0.2
# fraction of the run; measured as the others, see docs/benchmarks/index.md
FULL_OPACITY_FROM = 0.6
ALIKE_IMAGES = 12  # number of images in which colours are compared with the background


def build_trainer(
    config: Config,
    capture: Capture | None = None,
    *,
    restored: bool = False,
    images: ImageLoader | None = None,
    held_out: frozenset[int] = frozenset(),
    first: InitialGaussians | None = None,
    uncapped: Config | None = None,
) -> Trainer[Any]:
    """Return the trainer of a scene: its model begun, nothing trained.

    Args:
        capture: as ``prepared`` returned it; None: it is read now.
        restored: a checkpoint will be, so that it does not matter where the model begins: no points
            are triangulated.
        images: the training images of another trainer of the same ones; None: they are opened.
        held_out: indices of training views that are never trained on.
        first: Gaussians that it goes on from; None: it begins as ``config.init`` says.
        uncapped: the config without the limits of the run: it may begin with more Gaussians than it
            may end with; None: the same.
    """
    if capture is None:
        capture = read_capture(config.data) if restored else prepare_capture(config)
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
    extent = scene_geometry(capture).extent
    messages = [priors.message] if priors.message else []
    published = capture.has_alpha and config.train.alpha_weight == 0 and background != "random"
    if published and not restored:
        messages.append(
            f"images are compared on {background} alone, as published (train.alpha_weight=0): {background} surfaces "
            "may be transparent"
        )
    early = _early_opacity(config, capture, images, background)

    def parts(config: Config) -> TrainerParts:
        start = StartContext(
            config, uncapped or config, capture, images, background, extent, generator, first
        )
        model = kind.start(start)
        steps = config.train.steps
        views = images.views
        refinement = None
        if config.camera.refine == "always":
            refinement = CameraRefinement(views, extent, steps)
            correct_cameras = refinement.corrections.correct_cameras
            images.camera_correction = lambda index, cameras: correct_cameras(views[index], cameras)
        robust = None
        may_mask = "train.robust" in kind.uses and not isinstance(kind, HasMotion)
        if config.train.robust == "always" and may_mask:
            cameras = training_cameras(views, config.data)
            robust = RobustMasks(images, cameras, steps, images.camera_correction)
        exposures = None
        if config.train.exposure == "always":
            exposures = ViewExposures(len(images), steps, images)
        losses = [
            model.colour_loss or ImageLoss(config.train.ssim_weight),
            SilhouetteLoss(config.train.alpha_weight, early, FULL_OPACITY_FROM * steps),
            PenaltyLoss(),
            *([] if exposures is None else [exposures]),
            priors,
            RegularizerLoss(),
        ]
        found = (robust, exposures, refinement)
        return TrainerParts(model, losses, [x for x in found if x is not None])

    return Trainer(
        config=config,
        build_parts=parts,
        capture=capture,
        images=images,
        background=background,
        extent=extent,
        generator=generator,
        pending_messages=messages,
        held_out=held_out,
        device=select_device(config.run.device),
    )


def prepare_capture(config: Config) -> Capture:
    """Return the capture of a run with the points that its scene begins with, see
    ``with_first_points``.

    Problems of the capture and the source of its points are logged.
    """
    return add_initial_points(require_images(read_capture(config.data)), config)


def add_initial_points(capture: Capture, config: Config, *, log_messages: bool = True) -> Capture:
    """Return ``capture`` as ``prepared`` does, for a kind whose Gaussians begin at points; others
    need none."""
    lines: list[str] = []
    if "init" in find_kind(config.model).uses:
        init = config.init
        if isinstance(init, PointsInit):
            capture, lines = create_initial_points(capture, config.data, init)
        elif isinstance(init, RandomInit):
            views = capture.splits["train"]
            why = cube_mismatch_reason(
                views, cube_half_side(init.half_extent, views, capture.world_scale)
            )
            lines = (
                []
                if why is None
                else [f"init.kind=random draws points around the origin, but {why}: give auto"]
            )
    for line in [*lines, *check_before_training(capture)] if log_messages else []:
        log_warning(line)
    return capture


def _early_opacity(config: Config, capture: Capture, images: ImageLoader, background: str) -> float:
    """Return the fraction of train.alpha_weight that counts while motion is not followed yet.

    It depends on the capture alone, so that a moving model begins exactly as a static one.
    """
    is_still = len(set(training_times(capture))) < 2
    if (
        is_still
        or not capture.has_alpha
        or config.train.alpha_weight == 0
        or background == "random"
    ):
        return 1.0
    shown = (images[i] for i in evenly_spaced(len(images), ALIKE_IMAGES))
    alike = background_coloured_fraction(shown, background_colour(background))
    return 1.0 if alike is None or alike >= MANY_ALIKE else EARLY_OPACITY
