"""Model kind ``static``: static scenes of Gaussians."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dyngs.models.kind import HasSizeLimit
from dyngs.models.static_section import StaticModel

if TYPE_CHECKING:
    from dyngs.models.kind import Restore, Start


class StaticKind(HasSizeLimit):
    """Static scenes of Gaussians."""

    uses = HasSizeLimit.uses | {"init.scene"}
    speeds_up_short_runs = True

    def functions(self) -> tuple[Start, Restore]:
        from dyngs.gaussians.static_training import restore, start

        return start, restore


STATIC = StaticKind(StaticModel)
