"""Training of static scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.config import DefaultStrategy, SceneInit
from dyngs.core.camera import Cameras
from dyngs.core.section import SceneModel
from dyngs.core.state import Role, State, StateTensor
from dyngs.core.tensor_checks import require_tensor
from dyngs.data.times import evenly_spaced
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.filters import FilterUpdate
from dyngs.gaussians.initialization import (
    build_colour_training,
    build_densifier,
    build_filter_update,
    load_or_create_gaussians,
)
from dyngs.gaussians.model import GaussianModel, SceneTraining
from dyngs.gaussians.optimizer import FrozenMask
from dyngs.gaussians.rendering import contributions
from dyngs.gaussians.scene import restore_appearance
from dyngs.gaussians.static_scene import StaticScene
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import StartContext
from dyngs.models.schedule import scale_step
from dyngs.models.views import training_cameras

# Training views, evenly spaced, in which a Gaussian is looked for before it is removed
SURVEYED = 200


@dataclass(frozen=True)
class SmallGaussianPruning:
    """Removal, once, of Gaussians that amount to less than ``pixels`` in every one of some views.

    What a Gaussian amounts to is its blending weight, summed over an image: 1 for a pixel that
    shows nothing else.
    """

    step: int = 0  # after which that happens; 0: it does not
    pixels: float = 0.0
    cameras: Sequence[Cameras] = ()

    def edit(self, scene: StaticScene, stays: Tensor | None = None) -> EditResult | None:
        """Return the removal; None where all Gaussians, or none, amount to that much; ``stays``
        (N,) bool: these do."""
        drawn = scene.time_step(None).gaussians
        most = torch.zeros(len(scene), device=scene.device)
        for cameras in self.cameras:
            found = contributions(drawn, cameras.to(device=scene.device), scene.options)
            most = torch.maximum(most, found.amax(0))
        kept = most >= self.pixels if stays is None else (most >= self.pixels) | stays
        if bool(kept.all()) or not bool(kept.any()):
            return None
        text = (
            f"{len(scene) - int(kept.sum()):,} of {len(scene):,} Gaussians are removed: each makes up less than "
            f"{self.pixels:g} px of every training view (strategy.prune_pixels)"
        )
        return EditResult(TopologyEdit.select(kept), message=text)


def build_small_pruning(run: StartContext) -> SmallGaussianPruning:
    """Return when and by which views Gaussians of a run are removed: when no more are added."""
    config = run.config
    strategy = run.config.strategy
    if not (isinstance(strategy, DefaultStrategy) and strategy.prune_pixels > 0):
        return SmallGaussianPruning()
    views = run.capture.splits["train"]
    cameras = training_cameras([views[i] for i in evenly_spaced(len(views), SURVEYED)], config.data)
    return SmallGaussianPruning(
        scale_step(strategy.stop, config.train.steps), strategy.prune_pixels, cameras
    )


class StaticTraining(SceneTraining[StaticScene]):
    """See ``SceneTraining``; nothing is learned next to the Gaussians and their colours.

    ``still``: what stays as it is.
    """

    def __init__(
        self,
        update: FilterUpdate,
        removal: SmallGaussianPruning = SmallGaussianPruning(),
        frozen_mask: FrozenMask | None = None,
    ) -> None:
        self._update, self._removal, self._still = update, removal, frozen_mask

    def frozen_mask(self) -> FrozenMask | None:
        return self._still

    def follow(self, edit: TopologyEdit) -> None:
        if self._still is not None and self._still.rows is not None:
            self._still = replace(self._still, rows=edit.apply(self._still.rows))

    def state(self) -> State:
        rows = None if self._still is None else self._still.rows
        return {} if rows is None else {"frozen": StateTensor(rows, Role.TRAINING)}

    def first_scene(self, gaussians: Gaussians) -> StaticScene:
        return StaticScene(gaussians=gaussians, filter_std=self._update.of(gaussians))

    def after_step(self, scene: StaticScene, step: int, edited: bool) -> StaticScene:
        if self._update.is_due(step, edited):
            return replace(scene, filter_std=self._update.of(scene.gaussians))
        return scene

    def edit_scene(self, scene: StaticScene, step: int) -> tuple[StaticScene, EditResult] | None:
        rows = None if self._still is None else self._still.rows
        result = self._removal.edit(scene, rows) if step == self._removal.step else None
        if result is None or result.edit is None:
            return None
        return scene.apply_edit(result.edit), result

    def restore(self, gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> StaticScene:
        if self._still is not None and "frozen" in tensors:
            frozen = require_tensor("frozen", tensors["frozen"], (len(gaussians),), torch.bool)
            self._still = replace(self._still, rows=frozen.to(gaussians.means.device))
        return StaticScene.from_state(gaussians, tensors)


def _still(run: StartContext) -> FrozenMask | None:
    init = run.config.init
    rows = None if run.first is None else run.first.frozen
    return FrozenMask(rows, init.trainable == "colour") if isinstance(init, SceneInit) else None


def start(run: StartContext) -> GaussianModel:
    """Return the model of a static scene before its first step."""
    gaussians = load_or_create_gaussians(run)
    colours = build_colour_training(run, gaussians, uses_time=False)
    training = StaticTraining(build_filter_update(run), build_small_pruning(run), _still(run))
    return GaussianModel(
        run, training.first_scene(gaussians), training, build_densifier(run), colours
    )


def restore(model: SceneModel, checkpoint: Checkpoint) -> StaticScene:
    """Return the scene of a checkpoint."""
    scene = StaticScene.from_state(
        Gaussians.stored(checkpoint.part("gaussians")), checkpoint.part("model")
    )
    return restore_appearance(scene, model, checkpoint)
