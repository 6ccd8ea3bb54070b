"""The kinds of radiance fields: what they begin with, and how they are restored."""

from __future__ import annotations

from dyngs.errors import DyngsError
from dyngs.fields.field import Field
from dyngs.fields.keys import FieldModel, NgpModel
from dyngs.fields.ngp import NgpField
from dyngs.fields.ngp_training import NgpTraining
from dyngs.fields.scene import FieldScene, stored_space, stored_times
from dyngs.fields.space import space_of
from dyngs.fields.training import NEAR, FieldTraining
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import RunStart
from dyngs.models.renderable import DrawOptions
from dyngs.models.views import background_colour


def start(run: RunStart) -> FieldTraining[NgpField]:
    """Return the field of a capture before its first step."""
    model = run.config.model
    assert isinstance(model, FieldModel)
    with_capture = f"{run.config.data.root}: "
    try:
        space = space_of(model, model.cells if isinstance(model, NgpModel) else 1, run.capture)
    except DyngsError as error:
        raise DyngsError(with_capture + str(error)) from None
    assert isinstance(model, NgpModel)
    return NgpTraining(run, NgpField.new(model, space, run.generator), model)


def restore(model: FieldModel, checkpoint: Checkpoint) -> FieldScene:
    """Return the scene of a checkpoint."""
    stored = checkpoint.part("field")
    space = stored_space(stored)
    assert isinstance(model, NgpModel)
    field: Field = NgpField.restored(model, space, checkpoint)
    options = DrawOptions(near=NEAR * space.half)
    return FieldScene(field, stored_times(stored), options, background_colour(checkpoint.info.background))
