"""Model kind ``dynamic``: Gaussians moved by a deformation field."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dyngs.core.section import SceneModel
from dyngs.deform.keys import DynamicModel, FreeField
from dyngs.models.kind import HasMotion, HasSchedules, HasSizeLimit

if TYPE_CHECKING:
    from dyngs.data.capture import Capture
    from dyngs.models.kind import Restore, Start
    from dyngs.models.schedule import LengthChange


RATE_FACTOR = 2.0
"""Learning rate factor of free primitives, and of control nodes in clips.

Measured (docs/research-log.md): 2 gains on ``rig`` and ``stage``, and in short runs of clips; 3 loses
on ``rig``.
"""


class DynamicKind(HasSizeLimit, HasMotion, HasSchedules):
    """Dynamic scenes of Gaussians."""

    def refusal(self, capture: Capture) -> str | None:
        if len({view.time for view in capture.splits["train"]}) > 1:
            return None
        return (
            "the images have no times; train configs/static.yaml, add a time to each image "
            "(`dyngs docs captures`), or set data.times=order if the file names are in temporal order"
        )

    def rate_factor(self, section: DynamicModel) -> float:
        return RATE_FACTOR if isinstance(section.deform, FreeField) else 1.0

    def functions(self) -> tuple[Start, Restore]:
        from dyngs.deform.start import restore, start

        return start, restore

    def extend_schedules(self, section: DynamicModel, length: LengthChange) -> DynamicModel:
        from dyngs.deform.schedule import extend_schedules

        return extend_schedules(section, length)

    def with_added_gaussians(self, section: SceneModel, most: int) -> SceneModel:
        assert isinstance(section, DynamicModel)
        count = min(section.num_added_for_motion, most)
        return section.model_copy(update={"num_random_moving": count})

    def num_shared(self, section: DynamicModel, num_times: int, num_moving: int = 0) -> int:
        from dyngs.core.conventions import num_sh_terms
        from dyngs.deform.fields import num_values

        if num_times <= 1:
            return 0
        return num_values(section.deform, num_times, num_moving, num_sh_terms(section.sh_degree))


DYNAMIC = DynamicKind(DynamicModel)
