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

# Largest number of training views, evenly spaced, that measure contributions before pruning.
MEASURED_VIEWS = 200


@dataclass(frozen=True)
class SmallGaussianPruning:
    """One-time pruning of Gaussians that contribute less than ``pixels`` to every measured view.

    The contribution is the blending weight summed over an image: 1 for a pixel that shows only
    this Gaussian.
    """

    step: int  # step after which Gaussians are pruned
    pixels: float
    cameras: Sequence[Cameras]

    def edit(self, scene: StaticScene, protected: Tensor | None = None) -> EditResult | None:
        """Return the pruning edit, or None if all or no Gaussians contribute enough.

        ``protected`` (N,) bool: Gaussians that are never pruned.
        """
        drawn = scene.time_step(None).gaussians
        max_contribution = torch.zeros(len(scene), device=scene.device)
        for cameras in self.cameras:
            weights = contributions(drawn, cameras.to(device=scene.device), scene.options)
            max_contribution = torch.maximum(max_contribution, weights.amax(0))
        kept = max_contribution >= self.pixels
        kept = kept if protected is None else kept | protected
        if bool(kept.all()) or not bool(kept.any()):
            return None
        text = (
            f"pruned {len(scene) - int(kept.sum()):,} of {len(scene):,} Gaussians that cover less than "
            f"{self.pixels:g} px in every training view (strategy.prune_pixels)"
        )
        return EditResult(TopologyEdit.select(kept), message=text)


def build_small_pruning(run: StartContext) -> SmallGaussianPruning | None:
    """Return the pruning of small Gaussians, scheduled for the end of densification; None: off."""
    config = run.config
    strategy = run.config.strategy
    if not (isinstance(strategy, DefaultStrategy) and strategy.prune_pixels > 0):
        return None
    views = run.capture.splits["train"]
    cameras = training_cameras(
        [views[i] for i in evenly_spaced(len(views), MEASURED_VIEWS)], config.data
    )
    return SmallGaussianPruning(
        scale_step(strategy.stop, config.train.steps), strategy.prune_pixels, cameras
    )


class StaticTraining(SceneTraining[StaticScene]):
    """Training of a static scene, see ``SceneTraining``.

    Args:
        update: when and how the 3D smoothing filter of the Gaussians is computed again.
        pruning: one-time pruning of small Gaussians. Frozen Gaussians are not pruned.
        frozen_mask: parameters that are not trained.
    """

    def __init__(
        self,
        update: FilterUpdate,
        pruning: SmallGaussianPruning | None = None,
        frozen_mask: FrozenMask = FrozenMask(),
    ) -> None:
        self._update = update
        self._pruning = pruning
        self._frozen_mask = frozen_mask

    def frozen_mask(self) -> FrozenMask:
        return self._frozen_mask

    def apply_edit(self, edit: TopologyEdit) -> None:
        rows = self._frozen_mask.rows
        if rows is not None:
            self._frozen_mask = replace(self._frozen_mask, rows=edit.apply(rows))

    def state(self) -> State:
        rows = self._frozen_mask.rows
        return {} if rows is None else {"frozen": StateTensor(rows, Role.TRAINING)}

    def first_scene(self, gaussians: Gaussians) -> StaticScene:
        return StaticScene(gaussians=gaussians, filter_std=self._update.compute(gaussians))

    def after_step(self, scene: StaticScene, step: int, edited: bool) -> StaticScene:
        if self._update.is_due(step, edited):
            return replace(scene, filter_std=self._update.compute(scene.gaussians))
        return scene

    def edit_scene(self, scene: StaticScene, step: int) -> tuple[StaticScene, EditResult] | None:
        if self._pruning is None or step != self._pruning.step:
            return None
        result = self._pruning.edit(scene, self._frozen_mask.rows)
        if result is None or result.edit is None:
            return None
        return scene.apply_edit(result.edit), result

    def restore(self, gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> StaticScene:
        if "frozen" in tensors:
            frozen = require_tensor("frozen", tensors["frozen"], (len(gaussians),), torch.bool)
            self._frozen_mask = replace(self._frozen_mask, rows=frozen.to(gaussians.means.device))
        return StaticScene.from_state(gaussians, tensors)


def _build_frozen_mask(run: StartContext) -> FrozenMask:
    init = run.config.init
    if not isinstance(init, SceneInit):
        return FrozenMask()
    rows = None if run.first is None else run.first.frozen
    return FrozenMask(rows, init.trainable == "colour")


def start(run: StartContext) -> GaussianModel:
    """Create the model of a static scene before its first step."""
    gaussians = load_or_create_gaussians(run)
    colours = build_colour_training(run, gaussians, uses_time=False)
    training = StaticTraining(
        build_filter_update(run), build_small_pruning(run), _build_frozen_mask(run)
    )
    return GaussianModel(
        run, training.first_scene(gaussians), training, build_densifier(run), colours
    )


def restore(model: SceneModel, checkpoint: Checkpoint) -> StaticScene:
    """Return the scene in a checkpoint."""
    scene = StaticScene.from_state(
        Gaussians.stored(checkpoint.part("gaussians")), checkpoint.part("model")
    )
    return restore_appearance(scene, model, checkpoint)
