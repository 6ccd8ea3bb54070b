"""The kind ``bg_triangle``: curved triangles with sharp edges."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dyngs.baselines.triangles.keys import BgTriangleModel
from dyngs.models.kind import ExtendsTo

if TYPE_CHECKING:
    from dyngs.models.kind import Restore, Start
    from dyngs.models.schedule import Length


class BgTriangleKind(ExtendsTo):
    """See the module."""

    uses = ExtendsTo.uses | {
        "init",
        "train.exposure",
        "train.robust",
        "train.priors",
        "budget.max_mb",
    }

    def functions(self) -> tuple[Start, Restore]:
        from dyngs.baselines.triangles.start import restore, start

        return start, restore

    def extended(self, section: BgTriangleModel, length: Length) -> BgTriangleModel:
        return section.model_copy(update={"texture_from": length.share(section.texture_from)})


BG_TRIANGLE = BgTriangleKind(BgTriangleModel)
