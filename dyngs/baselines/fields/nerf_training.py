"""NeRF in training: so many rays of one image per step, squared errors of both networks, and its
schedule."""

from __future__ import annotations

from torch import Tensor

from dyngs.baselines.fields.keys import NerfModel
from dyngs.baselines.fields.nerf import NerfField
from dyngs.baselines.fields.scene import stored_space
from dyngs.baselines.fields.training import FieldTraining
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import RunStart

LAST_RATE = 0.1  # Of the rate at the end of the run, relative to the first; it falls exponentially


def squared(one: Tensor, other: Tensor) -> Tensor:
    """Return the squared differences."""
    return (one - other).square()


class NerfTraining(FieldTraining[NerfField]):
    """See the module."""

    def __init__(self, run: RunStart, field: NerfField, model: NerfModel) -> None:
        super().__init__(run, field, squared)
        self._model = model

    @property
    def num_rays(self) -> int:
        return max(1, self._model.rays // self._batch)

    def rate(self, step: int) -> float:
        return self._model.lr * LAST_RATE ** (step / self._run.config.train.steps)

    def restored_field(self, checkpoint: Checkpoint) -> NerfField:
        return NerfField.restored(self._model, stored_space(checkpoint.part("field")), checkpoint)
