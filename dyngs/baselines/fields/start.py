"""The kinds of radiance fields: what they begin with, and how they are restored."""

from __future__ import annotations

from typing import Any

from dyngs.baselines.fields.field import Field
from dyngs.baselines.fields.keys import NerfModel, NgpModel
from dyngs.baselines.fields.nerf import NerfField
from dyngs.baselines.fields.nerf_training import NerfTraining
from dyngs.baselines.fields.ngp import NgpField
from dyngs.baselines.fields.ngp_training import NgpTraining
from dyngs.baselines.fields.scene import FieldScene, stored_space, stored_times
from dyngs.baselines.fields.space import space_of
from dyngs.baselines.fields.training import NEAR, FieldTraining
from dyngs.core.errors import DyngsError
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import RunStart
from dyngs.models.renderable import DrawOptions
from dyngs.models.views import evaluation_background


def start(run: RunStart) -> FieldTraining[Any]:
    """Return the field of a capture before its first step. Raises DyngsError: a capture that it
    cannot hold."""
    model = run.config.model
    assert isinstance(model, (NgpModel, NerfModel))
    try:
        space = space_of(model, model.cells if isinstance(model, NgpModel) else 1, run.capture)
    except DyngsError as error:
        raise DyngsError(f"{run.config.data.root}: {error}") from None
    if isinstance(model, NgpModel):
        camera = run.images[0].cameras
        field = NgpField.new(model, space, run.generator, max(camera.width, camera.height))
        return NgpTraining(run, field, model)
    return NerfTraining(run, NerfField.new(model, space, run.generator), model)


def restore(model: NgpModel | NerfModel, checkpoint: Checkpoint) -> FieldScene:
    """Return the scene of a checkpoint."""
    stored = checkpoint.part("field")
    space = stored_space(stored)
    times = stored_times(stored)
    field: Field
    if isinstance(model, NgpModel):
        field = NgpField.restored(model, space, checkpoint)
    else:
        field = NerfField.restored(model, space, checkpoint)
    behind = evaluation_background(checkpoint.info.background, False)[1]
    return FieldScene(field, times, DrawOptions(near=NEAR * space.half), behind)
