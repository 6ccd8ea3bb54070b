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

# Slope of the hyperbolic tangent: second differences of a profile are small numbers
STEEPNESS = 4.0
VOLUME_POWER = 0.1


@dataclass(frozen=True)
class ScoringViews:
    """A scene, and the views that its Gaussians are scored on: every camera at every time."""

    scene: GaussianScene
    cameras: Sequence[Cameras]
    times: Sequence[float | None]
    options: RenderOptions
    background: Tensor


@dataclass(frozen=True)
class Importance:
    """Contributions C (K, N) of N Gaussians at K moments: sums over pixels and views, in one of
    several ways."""

    fractions: Tensor
    slopes: Tensor | None
    opacities: Tensor
    log_volumes: Tensor

    @property
    def contribution(self) -> Tensor:
        return self.fractions.sum(0)

    @property
    def variation(self) -> Tensor:
        """(N,) sum_k gamma(k) g(k) C(k), the spatio-temporal variation score of 4DGS-1K (Yuan et
        al. 2025) for a canonical form that moves.

        gamma(k) = V(k)^0.1 with the volume V, over that of the mean Gaussian; g(k) = 1 / (tanh(4
        |d(k)|) / 2 + 1/2) in (1, 2] with the second difference d of the profile p over moments.
        p is the opacity over its maximum where it
        changes, and otherwise what is seen, C, smoothed by [1 2 1] / 4, over its maximum.
        """
        volumes = (VOLUME_POWER * (self.log_volumes - self.log_volumes.mean())).exp()
        profile = self.opacities
        if not bool((profile != profile[:1]).any()):
            before, after = _neighbours(self.fractions)
            profile = (before + 2 * self.fractions + after) / 4
        profile = profile / profile.amax(0).clamp_min(torch.finfo(profile.dtype).tiny)
        before, after = _neighbours(profile)
        bend = after - 2 * profile + before
        variation = 1 / (0.5 * torch.tanh(STEEPNESS * bend.abs()) + 0.5)
        return (volumes * variation * self.fractions).sum(0)


def _neighbours(x: Tensor) -> tuple[Tensor, Tensor]:
    """Return (K, N) the rows before and after those of ``x`` (K, N), ends repeated."""
    return torch.cat([x[:1], x[:-1]]), torch.cat([x[1:], x[-1:]])


@torch.no_grad()
def measure_importance(views: ScoringViews, *, slopes: bool) -> Importance:
    """Return the contribution of each Gaussian to the images of ``views``; ``slopes`` cost the
    larger half."""
    scene = views.scene
    options = views.options
    behind = views.background
    fractions = []
    opacities = []
    volumes = []
    squares = torch.zeros((), device=behind.device)
    for time in views.times:
        moment = scene.time_step(time)
        now = moment.gaussians
        sums = [contributions(now, camera, options)[0] for camera in views.cameras]
        fractions.append(torch.stack(sums).sum(0))
        opacities.append(now.opacities)
        volumes.append(now.log_scales.sum(1))
        if slopes:
            shader = scene.shader(moment)
            for camera in views.cameras:
                squares = (
                    squares
                    + sensitivities(now, camera, options, background=behind, shader=shader)[0]
                )
    return Importance(
        torch.stack(fractions),
        squares if slopes else None,
        torch.stack(opacities),
        torch.stack(volumes),
    )


def select_highest(scores: Tensor, fraction: float) -> Tensor:
    """Return (N,) bool: all but the lowest ``fraction`` of ``scores`` (N,), at least one; of equal
    ones the first."""
    count = min(max(1, math.ceil(len(scores) * (1 - fraction) - 1e-9)), len(scores))
    kept = torch.zeros(len(scores), dtype=torch.bool, device=scores.device)
    kept[torch.sort(scores, descending=True, stable=True).indices[:count]] = True
    return kept


# Numbers of training cameras and times whose pairs are scored in dynamic scenes
MOVING_VIEWS, MOVING_TIMES = 8, 24
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
    message = f"pruned: {len(scene):,} -> "
    if edit.keep is None:
        return replace(
            edit, message=f"{message}{format_count(len(scene), 'Gaussian')}{_let_through(edit)}"
        )
    gain = mean_psnr(trainer, scene.select(edit.keep)) - mean_psnr(trainer, scene)
    left = format_count(int(edit.keep.sum()), "Gaussian")
    cost = f"{gain:+.2f} dB before fine-tuning"
    return replace(edit, message=f"{message}{left}, {cost}{_let_through(edit)}")


def _let_through(edit: TrainingEdit) -> str:
    masks = edit.masks
    if masks is None:
        return ""
    times = range(len(masks.times) - 1)
    active = fmean(len(masks.active(k)) / max(masks.count, 1) for k in times)
    return f"; visibility masks keep {active:.0%} of them"


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
    """Return (N,) how much each Gaussian matters now, by the score of ``options``; None: the first
    of docs/guides/smaller-and-faster.md."""
    score = (options or PruneConfig()).score
    scene = trainer.model.scene.without_masks()
    found = measure_importance(scoring_views(trainer, scene), slopes=score == "sensitivity")
    match score:
        case "variation":
            return found.variation
        case "contribution" | "sensitivity":
            return found.contribution if found.slopes is None else found.slopes


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
    trainer: GaussianTrainer, scene: GaussianScene, times: Sequence[float | None] | None = None
) -> ScoringViews:
    """Return all pairs of some training cameras and some times; with no times all that matters are
    cameras."""
    background = background_colour(trainer.background)
    if times is None:
        times = (
            [None]
            if scene.is_static
            else [scene.times[i] for i in evenly_spaced(len(scene.times), MOVING_TIMES)]
        )
    views = STILL_VIEWS if scene.is_static else MOVING_VIEWS
    cameras = distinct_cameras(trainer.images.cameras(), views)
    return ScoringViews(scene, cameras, times, trainer.model.options, background)


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
    """Return at which of evenly spaced key times each Gaussian kept is seen from any of the
    survey's cameras."""
    options = trainer.config.prune
    last = len(scene.times) - 1
    count = min(options.mask_times, len(scene.times))
    times = [scene.times[round(k * last / (count - 1))] for k in range(count)]
    fractions = measure_importance(scoring_views(trainer, scene, times), slopes=False).fractions
    seen = fractions > MASKED_BELOW
    moved = field_scene_of(scene)
    if moved is not None and moved.field is not None and moved.field.can_fade:
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
