"""The kind ``dynamic``: Gaussians that a field moves over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dyngs.core.section import SceneModel
from dyngs.deform.keys import (
    ControlNodesField,
    DynamicModel,
    FreeField,
    HexplaneField,
    MlpField,
)
from dyngs.models.kind import ExtendsTo, HasGaussians, Moves

if TYPE_CHECKING:
    from dyngs.data.capture import Capture
    from dyngs.models.kind import Restore, Start
    from dyngs.models.schedule import Length

MOVED_BYTES = 200  # Of a Gaussian that control nodes move: the Gaussian at a time
# Float32 copies of the features that a Gaussian takes from space-time grids: six planes, twice
LOOKUP_COPIES = 12
ACTIVATION_COPIES = 3
"""Float32 copies of the neurons of a network that moves Gaussians: before and behind, and a
gradient."""


class DynamicKind(HasGaussians, Moves, ExtendsTo):
    """See the module."""

    def refusal(self, capture: Capture) -> str | None:
        if len({view.time for view in capture.splits["train"]}) > 1:
            return None
        return (
            "the images have no times, so nothing can move; train configs/static.yaml, or add a time to each image "
            "(docs/formats.md), or give data.times=order if their names are in the order of time"
        )

    def functions(self) -> tuple[Start, Restore]:
        from dyngs.deform.start import restore, start

        return start, restore

    def motion_begins_after(self, section: DynamicModel, steps: int) -> int:
        from dyngs.deform.schedule import deform_schedule
        from dyngs.gaussians.schedule import Rates

        return deform_schedule(section, Rates(steps)).fine

    def extended(self, section: DynamicModel, length: Length) -> DynamicModel:
        from dyngs.deform.schedule import extended

        return extended(section, length)

    def num_added(self, section: DynamicModel) -> int:
        return section.added_for_motion

    def adding(self, section: SceneModel, most: int) -> SceneModel:
        assert isinstance(section, DynamicModel)
        count = min(self.num_added(section), most)
        return section.model_copy(update={"num_random_moving": count})

    def num_shared(self, section: DynamicModel, num_times: int, num_moving: int = 0) -> int:
        from dyngs.deform.fields import num_values

        return num_values(section.deform, num_times, num_moving) if num_times > 1 else 0

    def moving_bytes(self, section: DynamicModel) -> int:
        match section.deform:
            case HexplaneField() as field:
                return 4 * LOOKUP_COPIES * field.channels * len(field.levels)
            case MlpField() as field:
                return 4 * ACTIVATION_COPIES * field.depth * field.width
            case ControlNodesField() | FreeField():
                return MOVED_BYTES


DYNAMIC = DynamicKind(DynamicModel)
