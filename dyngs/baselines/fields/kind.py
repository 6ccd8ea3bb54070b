"""The kinds ``nerf`` and ``ngp``: radiance fields, which draw some pixels of an image at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dyngs.baselines.fields.keys import NerfModel, NgpModel
from dyngs.models.kind import ModelKind

if TYPE_CHECKING:
    from dyngs.models.kind import Restore, Start


class FieldKind(ModelKind):
    """See the module."""

    def functions(self) -> tuple[Start, Restore]:
        from dyngs.baselines.fields.training import restore, start

        return start, restore


NERF = FieldKind(NerfModel)
NGP = FieldKind(NgpModel)
