"""Scenes of checkpoints, of any kind of model."""

from __future__ import annotations

from dyngs.config import ModelSection
from dyngs.core.errors import DyngsError, reading
from dyngs.gaussians.scene import GaussianScene, require_gaussians
from dyngs.models.checkpoint import OTHER_CONFIG, Checkpoint
from dyngs.models.kind import kind_of
from dyngs.models.renderable import Renderable


def restored_model(checkpoint: Checkpoint, model: ModelSection) -> Renderable:
    """Return the scene of a checkpoint of ``model``.

    Raises:
        DyngsError: a tensor is missing, or is not as the model or the other tensors have it; names
            the file.
    """
    with reading(checkpoint.name, OTHER_CONFIG):
        try:
            return kind_of(model).restore(model, checkpoint)
        except KeyError as missing:
            raise DyngsError(
                f"{checkpoint.name} lacks {missing}; an earlier version wrote it: train anew"
            ) from None


def restored_scene(checkpoint: Checkpoint, model: ModelSection) -> GaussianScene:
    """Return the scene of a checkpoint of ``model``; see ``restored_model``."""
    return require_gaussians(restored_model(checkpoint, model), checkpoint.name)
