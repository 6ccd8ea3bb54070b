"""Model kinds ``nerf`` and ``ngp``: radiance fields, trained on random pixels of an image."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from dyngs.core.section import ModelSection
from dyngs.models.kind import ModelKind

if TYPE_CHECKING:
    from dyngs.models.kind import Restore, Start


class FieldModel(ModelSection):
    """Config keys of all radiance fields."""

    time: bool = Field(
        default=False, description="use time as a network input, for dynamic scenes (T-NeRF)"
    )
    half_extent: float | None = Field(
        default=None,
        gt=0,
        le=1e9,
        description="half side of the innermost cube, in the unit of the capture; null: the region framed by all "
        "cameras for objects, else the region of the cameras",
    )
    surroundings: Literal["auto", "never", "always"] = Field(
        default="auto",
        description="model the surroundings of that cube, up to 64 times as far; auto: if images have no alpha",
    )
    sizes: Literal["tiny", "cpu", "published"] = Field(
        default="cpu",
        description="sizes of networks, grids and batches: for tests, for a CPU, or as published",
    )
    lr: float | None = Field(
        default=None,
        gt=0,
        le=1,
        description="peak learning rate of Adam; null: 1e-2 for ngp, 1e-3 for nerf (published: 5e-4)",
    )


class NgpModel(FieldModel):
    """Instant-NGP (Müller et al. 2022) with the protocol of nerfacc's occupancy grid (Li et al.
    2023)."""

    kind: Literal["ngp"] = Field(
        default="ngp",
        description="radiance field: hash grid and small networks (Instant-NGP)",
    )


class NerfModel(FieldModel):
    """NeRF (Mildenhall et al. 2020)."""

    kind: Literal["nerf"] = Field(
        default="nerf", description="radiance field: two large networks (NeRF)"
    )


class NgpKind(ModelKind):
    """Instant-NGP."""

    def functions(self) -> tuple[Start, Restore]:
        from dyngs.baselines.fields import ngp, scene

        return ngp.NgpTraining, partial(scene.restore_scene, ngp.NgpField)


class NerfKind(ModelKind):
    """NeRF."""

    def functions(self) -> tuple[Start, Restore]:
        from dyngs.baselines.fields import nerf, scene

        return nerf.NerfTraining, partial(scene.restore_scene, nerf.NerfField)


NERF = NerfKind(NerfModel)
NGP = NgpKind(NgpModel)
