"""The kind ``bg_triangle``: curved triangles with sharp edges."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dyngs.baselines.triangles.keys import BgTriangleModel
from dyngs.models.kind import ModelKind

if TYPE_CHECKING:
    from dyngs.models.kind import Restore, Start


class BgTriangleKind(ModelKind):
    """See the module."""

    uses = ModelKind.uses | {
        "init",
        "train.exposure",
        "train.robust",
        "train.priors",
        "budget.max_mb",
    }

    def functions(self) -> tuple[Start, Restore]:
        from dyngs.baselines.triangles.training import restore, start

        return start, restore


BG_TRIANGLE = BgTriangleKind(BgTriangleModel)
