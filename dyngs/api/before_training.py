"""What a capture needs before it is trained on: poses of photos and videos, a body fitted to a person."""

from __future__ import annotations

from collections.abc import Callable

from dyngs.capture.unposed import is_unposed, with_poses
from dyngs.config import Config, HumanModel
from dyngs.conventions import ReportProgress, report_nothing
from dyngs.errors import DyngsError
from dyngs.human.fit.fitted_capture import with_fitted_body


def with_capture(
    config: Config, *, say: Callable[[str], None] = print, report: ReportProgress = report_nothing
) -> Config:
    """Return the configuration with a capture that can be trained on; what is found for it is kept for other runs."""
    data, model = config.data, config.model
    if model.is_network:
        return config  # its folder holds a capture per person
    if not model.is_posed:
        data = with_poses(data, needs_times=model.may_move, say=say, report=report)
    elif is_unposed(data):
        raise DyngsError(
            f"{data.root}: a person needs a capture with body parameters (docs/human.md); of photos or videos alone a "
            f"scene can be made: `dyngs train static data.root={data.root}`, or dynamic"
        )
    elif isinstance(model, HumanModel) and model.body is None:
        data = with_fitted_body(data, only_if_needed=not model.fit, say=say, report=report)
    return config.model_copy(update={"data": data})
