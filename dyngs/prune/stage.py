"""The last stage of a run: few of its Gaussians are kept, masks say when they are seen, and training goes on with them.

It begins where training ends, from that checkpoint, and lasts ``prune.steps``: a finished run that is compacted ends
with the same bytes as one that had the stage in its configuration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from dyngs.build import training_cameras
from dyngs.camera import Cameras
from dyngs.config import PruneConfig
from dyngs.data.frame_selection import evenly_spaced
from dyngs.data.loader import Picture
from dyngs.deform.masks import KeyMasks
from dyngs.deform.model import DynamicScene
from dyngs.deform.trained import TrainedScene
from dyngs.evaluate.metrics import psnr
from dyngs.prune.score import Survey, Worth, worth
from dyngs.prune.selection import Pruning, prune
from dyngs.runs.checkpoint import stored_scene
from dyngs.scene import Scene, moment_of
from dyngs.static.fixed import FixedDensifier
from dyngs.train.background import background_colour

if TYPE_CHECKING:
    from dyngs.train.step import Trainer

MOVING_VIEWS, MOVING_TIMES = 8, 24
"""Training cameras and times of which all pairs are looked at where things move."""
STILL_VIEWS = 100
PROBED_VIEWS = 16
"""Training pictures by which the loss is measured."""
HIDDEN = -1e4
"""Logit of the opacity of what is not drawn: exactly 0."""


@dataclass(frozen=True)
class Compaction:
    """What the stage did to a run.

    Attributes:
        before, after: numbers of Gaussians.
        asked, share: what was to be removed, and what was.
        loss: dB on training pictures, before anything is trained again.
        active: mean share of the kept that masks let through; 1 without masks.
    """

    before: int
    after: int
    asked: float
    share: float
    loss: float
    active: float

    def __str__(self) -> str:
        backed_off = f" (not {self.asked:.0%}: that would cost too much)" if self.share < self.asked else ""
        masks = "" if self.active == 1 else f"; masks let {self.active:.0%} of them through"
        return (
            f"compacted: {self.before:,} -> {self.after:,} Gaussians, {self.share:.1%} removed{backed_off}, "
            f"{-self.loss:+.2f} dB before it is trained again{masks}"
        )


@torch.no_grad()
def compact_(trainer: Trainer) -> Compaction:
    """What was done; prunes and masks the Gaussians of ``trainer``, which from here on leaves their number alone."""
    options = trainer.config.prune
    scene = stored_scene(trainer.checkpoint(), trainer.config.model)
    if isinstance(scene, TrainedScene):
        scene = scene.unmasked()
    pruning = Pruning(torch.ones(len(scene), dtype=torch.bool), 0.0, 0.0)
    if options.share > 0:
        pruning = _pruning(trainer, scene)
        trainer.keep(pruning.kept)
    trainer.densifier = FixedDensifier()
    active = 1.0
    if isinstance(trainer.model, DynamicScene):
        trainer.model.masks = None
        if options.mask_times > 1 and not scene.is_still:
            trainer.model.masks = masks = _masks(trainer, scene, pruning.kept)
            intervals = range(len(masks.times) - 1)
            active = fmean(len(masks.active(k)) / max(masks.count, 1) for k in intervals)
    after = int(pruning.kept.sum())
    return Compaction(len(pruning.kept), after, options.share, pruning.share, pruning.loss, active)


def _pruning(trainer: Trainer, scene: Scene) -> Pruning:
    """What may go of ``scene``."""
    options = trainer.config.prune
    found = worth(survey_of(trainer, scene), slopes=options.score == "sensitivity")
    pictures = [trainer.pictures[i] for i in evenly_spaced(len(trainer.pictures), PROBED_VIEWS)]
    whole = quality_of(trainer, scene, pictures, None)

    def loss_of(kept: Tensor) -> float:
        return whole - quality_of(trainer, scene, pictures, kept)

    return prune(scores_of(found, options), options.share, loss_of, options.max_loss)


def scores_of(found: Worth, options: PruneConfig) -> Tensor:
    """(N,) the score asked for."""
    if options.score == "variation":
        return found.variation
    if options.score == "temporal":
        return found.temporal
    return found.contribution if found.slopes is None else found.slopes


def distinct_cameras(cameras: Sequence[Cameras], count: int) -> list[Cameras]:
    """At most ``count`` of the ``cameras`` that differ, evenly chosen: of a rig that stands, each once."""
    found: dict[bytes, Cameras] = {}
    for camera in cameras:
        numbers = torch.cat([camera.cam_from_world[0, :3], camera.intrinsics[0]], dim=1)
        found.setdefault(numbers.numpy().tobytes(), camera)
    different = list(found.values())
    return [different[i] for i in evenly_spaced(len(different), count)]


def survey_of(trainer: Trainer, scene: Scene, times: Sequence[float | None] | None = None) -> Survey:
    """All pairs of some training cameras and some times; with no times all that matters are cameras."""
    background = background_colour(trainer.background)
    if times is None:
        times = [None] if scene.is_still else [scene.times[i] for i in evenly_spaced(len(scene.times), MOVING_TIMES)]
    views = STILL_VIEWS if scene.is_still else MOVING_VIEWS
    cameras = distinct_cameras(training_cameras(trainer.pictures.views, trainer.config.data), views)
    return Survey(scene.at, scene.shader_at, cameras, times, trainer.options, background)


def quality_of(trainer: Trainer, scene: Scene, pictures: Sequence[Picture], kept: Tensor | None) -> float:
    """Mean PSNR of the training pictures with only ``kept`` (N,) bool of the Gaussians drawn; None: all."""
    background = background_colour(trainer.background)
    values = []
    for picture in pictures:
        now = moment_of(scene, picture.time)
        if kept is not None:
            logits = torch.where(kept, now.gaussians.logit_opacities, HIDDEN)
            now = replace(now, gaussians=now.gaussians.replace(logit_opacities=logits))
        drawn = now.seen_by(picture.cameras, trainer.options, background).rgb[0]
        values.append(psnr(drawn, picture.composite(background), picture.mask))
    return fmean(values)


def _masks(trainer: Trainer, scene: Scene, kept: Tensor) -> KeyMasks:
    """At which of evenly spaced key times each Gaussian kept is seen from any of the survey's cameras."""
    options, last = trainer.config.prune, len(scene.times) - 1
    count = min(options.mask_times, len(scene.times))
    times = [scene.times[round(k * last / (count - 1))] for k in range(count)]
    shares = worth(survey_of(trainer, scene, times), slopes=False).shares
    return KeyMasks.pack(tuple(times), shares[:, kept] > options.mask_below)
