"""Training of a static scene: on every image, with its 3D filter kept up to date."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from torch import Tensor

from dyngs.config import StaticModel
from dyngs.gaussians import Gaussians
from dyngs.gaussians.filters import FilterUpdate
from dyngs.gaussians.model import GaussianModel, SceneTraining
from dyngs.gaussians.scene import drawn_as_trained
from dyngs.gaussians.start import colours_of, densifier_of, filter_update, first_gaussians
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import RunStart
from dyngs.static.scene import StaticScene


class StaticTraining(SceneTraining[StaticScene]):
    """See ``SceneTraining``; nothing is learned next to the Gaussians and their colours."""

    def __init__(self, update: FilterUpdate) -> None:
        self._update = update

    def first_scene(self, gaussians: Gaussians) -> StaticScene:
        return StaticScene(gaussians=gaussians, filter_std=self._update.of(gaussians))

    def after_step(self, scene: StaticScene, step: int, edited: bool) -> StaticScene:
        if self._update.is_due(step, edited):
            return replace(scene, filter_std=self._update.of(scene.gaussians))
        return scene

    def restored(self, gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> StaticScene:
        return StaticScene.restored(gaussians, tensors)


def start(run: RunStart) -> GaussianModel:
    """Return the model of a static scene before its first step."""
    gaussians = first_gaussians(run)
    colours, training = colours_of(run, gaussians, sees_time=False), StaticTraining(filter_update(run))
    return GaussianModel(run, training.first_scene(gaussians), training, densifier_of(run), colours)


def restore(model: StaticModel, checkpoint: Checkpoint) -> StaticScene:
    """Return the scene of a checkpoint."""
    scene = StaticScene.restored(Gaussians.stored(checkpoint.part("gaussians")), checkpoint.part("model"))
    return drawn_as_trained(scene, model, checkpoint)
