"""The last stage of a run: few of its Gaussians are kept, masks say when they are seen, and training goes on with them.

The fraction that goes is input here; ``dyngs.prune.search`` finds it, and what else can go, with the same functions.

It begins where training ends, from that checkpoint, and lasts ``prune.steps``: a finished run that is pruned ends
with the same bytes as one that had the stage in its configuration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.config import PruneConfig
from dyngs.data.loader import Image
from dyngs.data.times import evenly_spaced
from dyngs.errors import counted
from dyngs.gaussians.scene import GaussianScene
from dyngs.gaussians.visibility import VisibilityMasks
from dyngs.kinds import GaussianTrainer
from dyngs.metrics import psnr
from dyngs.models.views import background_colour
from dyngs.ops.device import sent
from dyngs.prune.score import Importance, ScoringViews, highest, importance
from dyngs.training.events import Event, Message, Started, StepDone, TopologyChanged
from dyngs.training.loop import Loop

MOVING_VIEWS, MOVING_TIMES = 8, 24  # Numbers of training cameras and times whose pairs are scored in dynamic scenes
STILL_VIEWS = 100
PROBED_VIEWS = 16  # Number of training images on which the loss is measured
MASKED_BELOW = 0.5
"""At a key time, Gaussians that contribute no more px to all views together are masked (docs/prune.md)."""


@dataclass(frozen=True)
class Pruned:
    """Result of the pruning stage of a run."""

    before: int
    after: int
    loss: float
    active: float  # mean fraction of the kept that masks let through; 1 without masks

    def __str__(self) -> str:
        masks = "" if self.active == 1 else f"; masks let {self.active:.0%} of them through"
        return (
            f"pruned: {self.before:,} -> {counted(self.after, 'Gaussian')}, "
            f"{1 - self.after / max(self.before, 1):.1%} removed, "
            f"{-self.loss:+.2f} dB before it is trained again{masks}"
        )


class PruneStage:
    """Listener that prunes when training ends and fine-tuning begins."""

    def __init__(self, loop: Loop, trainer: Callable[[], GaussianTrainer]) -> None:
        self._loop, self._trainer = loop, trainer

    def __call__(self, event: Event) -> None:
        match event:
            case Started() | StepDone() if event.step == self._trainer().config.train.steps < event.total:
                done = prune_(self._trainer())
                self._loop.tell(Message(str(done)))
                self._loop.tell(TopologyChanged(event.step, done.before, done.after))


@torch.no_grad()
def prune_(trainer: GaussianTrainer) -> Pruned:
    """Prune and mask the Gaussians of ``trainer`` as its configuration says; from here on their number stays."""
    trainer.model.exchange(trainer.model.scene.unmasked())
    before, whole = len(trainer.model.scene), training_quality(trainer, trainer.model.scene)
    remove_(trainer, chosen_scores(trainer) if trainer.config.prune.fraction > 0 else None)
    scene, active = trainer.model.scene, 1.0
    loss = whole - training_quality(trainer, scene.unmasked())
    if scene.masks is not None:
        masks = scene.masks
        active = fmean(len(masks.active(k)) / max(masks.count, 1) for k in range(len(masks.times) - 1))
    return Pruned(before, len(scene), loss, active)


@torch.no_grad()
def remove_(trainer: GaussianTrainer, scores: Tensor | None) -> None:
    """Leave all but the fraction ``prune.fraction`` with the lowest ``scores`` (N,), and mask them if requested."""
    options = trainer.config.prune
    whole = trainer.model.scene.unmasked()
    trainer.model.exchange(whole)
    kept = torch.ones(len(whole), dtype=torch.bool, device=whole.gaussians.means.device)
    if scores is not None:
        kept = highest(scores, options.fraction)
        trainer.model.keep(kept, trainer.done)
    trainer.model.stop_growing()
    if options.mask_times > 1 and trainer.config.model.may_move and not whole.is_static:
        trainer.model.exchange(replace(trainer.model.scene, masks=_masks(trainer, whole, kept)))


@torch.no_grad()
def chosen_scores(trainer: GaussianTrainer) -> Tensor:
    """Return (N,) the score that the configuration asks for."""
    options, scene = trainer.config.prune, trainer.model.scene.unmasked()
    return scores_of(importance(scoring_views(trainer, scene), slopes=options.score == "sensitivity"), options)


def scores_of(found: Importance, options: PruneConfig) -> Tensor:
    """Return (N,) the score asked for."""
    match options.score:
        case "variation":
            return found.variation
        case "temporal":
            return found.temporal
        case "contribution" | "sensitivity":
            return found.contribution if found.slopes is None else found.slopes


@torch.no_grad()
def default_scores(trainer: GaussianTrainer) -> Tensor:
    """Return (N,) how much each Gaussian matters now: the first score of docs/prune.md."""
    scene = trainer.model.scene.unmasked()
    return scores_of(importance(scoring_views(trainer, scene), slopes=True), PruneConfig())


def distinct_cameras(cameras: Sequence[Cameras], count: int) -> list[Cameras]:
    """Return at most ``count`` distinct ``cameras``, evenly chosen: each camera of a fixed rig once."""
    found: dict[bytes, Cameras] = {}
    for camera in cameras:
        numbers = torch.cat([camera.cam_from_world[0, :3], camera.intrinsics[0]], dim=1)
        found.setdefault(numbers.cpu().numpy().tobytes(), camera)
    different = list(found.values())
    return [different[i] for i in evenly_spaced(len(different), count)]


def scoring_views(
    trainer: GaussianTrainer, scene: GaussianScene, times: Sequence[float | None] | None = None
) -> ScoringViews:
    """Return all pairs of some training cameras and some times; with no times all that matters are cameras."""
    background = background_colour(trainer.background)
    if times is None:
        times = [None] if scene.is_static else [scene.times[i] for i in evenly_spaced(len(scene.times), MOVING_TIMES)]
    views = STILL_VIEWS if scene.is_static else MOVING_VIEWS
    cameras = distinct_cameras(trainer.images.cameras(), views)
    return ScoringViews(scene, cameras, times, trainer.model.options, background)


@torch.no_grad()
def training_quality(trainer: GaussianTrainer, scene: GaussianScene) -> float:
    """Return the mean PSNR of at most 16 training images drawn of ``scene``, dB."""
    return quality_of(trainer, scene, probe_images(trainer))


def probe_images(trainer: GaussianTrainer) -> list[Image]:
    """Return at most 16 training images, evenly chosen."""
    return [trainer.images[i] for i in evenly_spaced(len(trainer.images), PROBED_VIEWS)]


@torch.no_grad()
def quality_of(
    trainer: GaussianTrainer, scene: GaussianScene, images: Sequence[Image], alpha_min: float | None = None
) -> float:
    """Return the mean PSNR of ``images`` drawn of ``scene``, dB; ``alpha_min`` instead of that of training."""
    background, options = sent(background_colour(trainer.background), trainer.device), trainer.model.options
    options = options if alpha_min is None else replace(options, alpha_min=alpha_min)
    scene, values = scene.to(trainer.device), []
    for image in images:
        drawn = scene.render(image.cameras, image.time, options=options, background=background).rgb[0]
        values.append(psnr(drawn, image.composite(background), image.mask))
    return fmean(values)


def _masks(trainer: GaussianTrainer, scene: GaussianScene, kept: Tensor) -> VisibilityMasks:
    """Return at which of evenly spaced key times each Gaussian kept is seen from any of the survey's cameras."""
    options, last = trainer.config.prune, len(scene.times) - 1
    count = min(options.mask_times, len(scene.times))
    times = [scene.times[round(k * last / (count - 1))] for k in range(count)]
    fractions = importance(scoring_views(trainer, scene, times), slopes=False).fractions
    return VisibilityMasks.pack(tuple(times), fractions[:, kept] > MASKED_BELOW)
