"""Pruning stage after training: remove Gaussians, compute visibility masks, and fine-tune.

The fraction is given here; ``dyngs.compress.search`` finds it for a given loss. The stage starts
from the last checkpoint and takes ``prune.steps``. Pruning a finished run gives the same bytes as
training with the stage in its configuration.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import fmean
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import softplus

from dyngs.config import PruneConfig
from dyngs.core.camera import Cameras
from dyngs.core.errors import format_count
from dyngs.core.metrics import psnr
from dyngs.data.loader import Image
from dyngs.data.times import evenly_spaced
from dyngs.deform.scene import field_scene_of
from dyngs.gaussians.rendering import RenderOptions, contributions, sensitivities
from dyngs.gaussians.scene import GaussianScene
from dyngs.gaussians.visibility import VisibilityMasks
from dyngs.models.kind import HasMotion, capability
from dyngs.models.renderable import Renderable
from dyngs.models.views import background_colour
from dyngs.ops.device import copy_async
from dyngs.training.loop import Loop
from dyngs.training.new_trainer import GaussianTrainer
from dyngs.training.trainer import Trainer, TrainingEdit

VOLUME_POWER = 0.1  # of 4DGS-1K and LightGaussian
# Maximum number of scored training images; beyond it, those of evenly spaced times are used
MOST_SCORED_IMAGES = 400


@dataclass(frozen=True)
class ScoringViews:
    """A scene, and the cameras at each time that its Gaussians are scored on."""

    scene: GaussianScene
    cameras: Sequence[tuple[float | None, Sequence[Cameras]]]
    options: RenderOptions
    background: Tensor


@torch.no_grad()
def measure_contributions(views: ScoringViews) -> Tensor:
    """Return the blending weights (K, N) of N Gaussians, summed over pixels and cameras at each of
    K times."""
    rows = []
    for time, cameras in views.cameras:
        now = views.scene.time_step(time).gaussians
        sums = [contributions(now, camera, views.options)[0] for camera in cameras]
        rows.append(torch.stack(sums).sum(0))
    return torch.stack(rows)


@torch.no_grad()
def measure_sensitivities(views: ScoringViews) -> Tensor:
    """Return ``sensitivities`` (N,), summed over all views."""
    scene = views.scene
    total = torch.zeros((), device=views.background.device)
    for time, cameras in views.cameras:
        moment = scene.time_step(time)
        shader = scene.shader(moment)
        for camera in cameras:
            slopes = sensitivities(
                moment.gaussians,
                camera,
                views.options,
                background=views.background,
                shader=shader,
            )
            total = total + slopes[0]
    return total


@torch.no_grad()
def log_temporal_scores(
    scene: GaussianScene, clip_length: float = 1.0, *, signed: bool = False
) -> Tensor:
    """Return the logarithms (N,) of the temporal scores of 4DGS-1K (Yuan et al. 2025), float64.

    A score is V^0.1 sum_t 1 / (0.5 tanh(x(t)) + 0.5) over all training times. V is the 4D volume.
    x is the second derivative of the opacity by time, or its magnitude unless ``signed``; it is 0
    where the opacity does not change. The sum is 1 + exp(-2 x) per time, added as logarithms.

    Args:
        clip_length: in the unit of time of the derivative; it matters, because tanh saturates.
    """
    log_volumes = scene.gaussians.log_scales.double().sum(1)
    num_times = max(len(scene.times), 1)
    log_sums = torch.full_like(log_volumes, math.log(2 * num_times))
    moved = field_scene_of(scene)
    if moved is not None and moved.field is not None:
        moving = moved.gaussians.select(moved.moving)
        total: Tensor | None = None
        for time in moved.times:
            window = moved.field.opacity_window(moving, time)
            if window is None:
                break
            x = window.curvature / clip_length**2
            term = softplus(-2 * (x if signed else x.abs()))
            total = term if total is None else torch.logaddexp(total, term)
            log_volumes[moved.moving] = moving.log_scales.double().sum(1) + window.log_spans
        if total is not None:
            log_sums[moved.moving] = total
    return log_sums + VOLUME_POWER * log_volumes


def select_highest(scores: Tensor, fraction: float) -> Tensor:
    """Return (N,) bool: all but the lowest ``fraction`` of ``scores`` (N,), at least one; of equal
    ones the first."""
    count = min(max(1, math.ceil(len(scores) * (1 - fraction) - 1e-9)), len(scores))
    kept = torch.zeros(len(scores), dtype=torch.bool, device=scores.device)
    kept[torch.sort(scores, descending=True, stable=True).indices[:count]] = True
    return kept


# Numbers of training cameras and times whose pairs are scored in dynamic scenes
MOVING_VIEWS, MOVING_TIMES = 8, 24
# Most training cameras of a static scene that are scored, and from which masks are computed
STILL_VIEWS = 100
PROBED_VIEWS = 16  # Number of training images on which the loss is measured
MASKED_BELOW = 0.5
"""At a key time, Gaussians that contribute no more px to all views together are masked
(docs/guides/smaller-and-faster.md)."""


def prune_stage(loop: Loop) -> TrainingEdit | None:
    """Editor that prunes and masks when training ends and fine-tuning begins."""
    trainer = loop.trainer
    assert isinstance(trainer, Trainer)
    config = trainer.config
    if trainer.done != config.train.steps or trainer.done >= loop.total:
        return None
    return build_pruning_edit(trainer)


@torch.no_grad()
def build_pruning_edit(trainer: GaussianTrainer) -> TrainingEdit:
    """Return the edit that prunes and masks the Gaussians of ``trainer`` by its config."""
    scene = trainer.model.scene.without_masks()
    options = trainer.config.prune
    edit = build_removal_edit(
        trainer, importance_scores(trainer, options) if options.fraction > 0 else None
    )
    left = scene if edit.keep is None else scene.select(edit.keep)
    message = f"pruned: {len(scene):,} -> {format_count(len(left), 'Gaussian')}"
    if edit.keep is not None:
        gain = mean_psnr(trainer, left) - mean_psnr(trainer, scene)
        message += f", {gain:+.2f} dB before fine-tuning"
    masks = edit.masks
    if masks is not None:
        times = range(len(masks.times) - 1)
        active = fmean(len(masks.active(k)) / max(masks.count, 1) for k in times)
        message += f"; visibility masks keep {active:.0%} of them"
    return replace(edit, message=message)


@torch.no_grad()
def build_removal_edit(trainer: GaussianTrainer, scores: Tensor | None) -> TrainingEdit:
    """Return the edit that removes the fraction ``prune.fraction`` with the lowest ``scores`` (N,).

    It also masks the Gaussians over time if requested. Their number is constant from then on.
    """
    options = trainer.config.prune
    whole = trainer.model.scene.without_masks()
    kept = None if scores is None else select_highest(scores, options.fraction)
    masks = None
    moves = capability(trainer.config.model, HasMotion) is not None and not whole.is_static
    if options.mask_times > 1 and moves:
        masks = _masks(trainer, whole, kept)
    return TrainingEdit(keep=kept, masks=masks, stops_densification=True)


@torch.no_grad()
def importance_scores(trainer: GaussianTrainer, options: PruneConfig | None = None) -> Tensor:
    """Return (N,) how much each Gaussian matters, by the score of ``options``, in any unit.

    Docs: docs/concepts/motion.md.
    """
    options = options or PruneConfig()
    scene = trainer.model.scene.without_masks()
    if options.score == "sensitivity":
        return measure_sensitivities(scoring_views(trainer, scene))
    clip_length = trainer.capture.seconds or 1.0
    temporal = log_temporal_scores(scene, clip_length, signed=options.signed)
    if options.score == "temporal":
        return temporal
    contribution = measure_contributions(training_views(trainer, scene)).sum(0)
    return contribution if options.score == "contribution" else contribution.log() + temporal


def distinct_cameras(cameras: Sequence[Cameras], count: int) -> list[Cameras]:
    """Return at most ``count`` distinct ``cameras``, evenly chosen: each camera of a fixed rig
    once."""
    found: dict[bytes, Cameras] = {}
    for camera in cameras:
        numbers = torch.cat([camera.cam_from_world[0, :3], camera.intrinsics[0]], dim=1)
        found.setdefault(numbers.cpu().numpy().tobytes(), camera)
    different = list(found.values())
    return [different[i] for i in evenly_spaced(len(different), count)]


def scoring_views(
    trainer: GaussianTrainer,
    scene: GaussianScene,
    times: Sequence[float] | None = None,
    most: int = MOVING_VIEWS,
) -> ScoringViews:
    """Return all pairs of ``most`` training cameras and ``times``; None: some training times."""
    if times is None:
        times = [scene.times[i] for i in evenly_spaced(len(scene.times), MOVING_TIMES)]
    cameras = distinct_cameras(trainer.images.cameras(), STILL_VIEWS if scene.is_static else most)
    groups = [(None, cameras)] if scene.is_static else [(time, cameras) for time in times]
    return ScoringViews(scene, groups, trainer.model.options, background_colour(trainer.background))


def training_views(trainer: GaussianTrainer, scene: GaussianScene) -> ScoringViews:
    """Return the training views; if there are too many, those of evenly spaced times."""
    views = scoring_views(trainer, scene, [])
    if scene.is_static:
        return views
    groups: dict[float, list[Cameras]] = {}
    for time, camera in zip(trainer.images.times, trainer.images.cameras(), strict=True):
        groups.setdefault(time or 0.0, []).append(camera)
    times = sorted(groups)
    count = max(MOST_SCORED_IMAGES * len(times) // len(trainer.images), 1)
    chosen = [times[i] for i in evenly_spaced(len(times), count)]
    return replace(views, cameras=[(time, groups[time]) for time in chosen])


def probe_images(trainer: Trainer[Any]) -> list[Image]:
    """Return at most 16 training images, evenly chosen."""
    return [trainer.images[i] for i in evenly_spaced(len(trainer.images), PROBED_VIEWS)]


@torch.no_grad()
def mean_psnr(
    trainer: Trainer[Any],
    scene: Renderable,
    images: Sequence[Image] | None = None,
    alpha_min: float | None = None,
) -> float:
    """Return the mean PSNR of ``images`` drawn of ``scene``, dB; by default of ``probe_images``, as
    in training."""
    background = copy_async(background_colour(trainer.background), trainer.device)
    options = trainer.model.options
    options = options if alpha_min is None else replace(options, alpha_min=alpha_min)
    scene = scene.to(trainer.device)
    values = []
    for image in probe_images(trainer) if images is None else images:
        drawn = scene.render(image.cameras, image.time, options=options, background=background).rgb[
            0
        ]
        values.append(psnr(drawn, image.composite(background), image.mask))
    return fmean(values)


def _masks(trainer: GaussianTrainer, scene: GaussianScene, kept: Tensor | None) -> VisibilityMasks:
    """Return which of the Gaussians ``kept`` are visible from any training camera at evenly spaced
    key times, or around them."""
    options = trainer.config.prune
    last = len(scene.times) - 1
    count = min(options.mask_times, len(scene.times))
    times = [scene.times[round(k * last / (count - 1))] for k in range(count)]
    seen = measure_contributions(scoring_views(trainer, scene, times, STILL_VIEWS)) > MASKED_BELOW
    moved = field_scene_of(scene)
    can_fade = moved is not None and moved.field is not None and moved.field.can_fade
    if options.mask_between and can_fade:
        seen |= visible_between_times(scene, times, trainer.model.options.alpha_min).to(seen.device)
    return VisibilityMasks.pack(tuple(times), seen if kept is None else seen[:, kept])


def visible_between_times(scene: GaussianScene, times: Sequence[float], alpha_min: float) -> Tensor:
    """Return (K, N) bool: which Gaussians are more opaque than ``alpha_min`` between one of K key
    times and the next.

    At the training times and in the middle between any two: what is there for a while only may miss
    all key times.
    """
    looked_at = sorted({*scene.times, *((a + b) / 2 for a, b in pairwise(scene.times))})
    found = torch.zeros(len(times), len(scene), dtype=torch.bool, device=scene.device)
    for time in looked_at:
        found[max(bisect_right(times, time) - 1, 0)] |= scene.at(time).opacities > alpha_min
    return found
