"""The kinds ``nerf`` and ``ngp``: radiance fields, which draw some pixels of an image at a time."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from dyngs.core.section import ModelSection
from dyngs.models.kind import ModelKind

if TYPE_CHECKING:
    from dyngs.models.kind import Restore, Start


class FieldModel(ModelSection):
    """Keys of all fields."""

    time: bool = Field(default=False, description="time is an input, too: a moving scene (T-NeRF)")
    half_extent: float | None = Field(
        default=None,
        gt=0,
        le=1e9,
        description="half the side of the cube that is resolved best, in the unit of the capture; null: what all "
        "cameras frame of an object before a background, else where the cameras are",
    )
    surroundings: Literal["auto", "never", "always"] = Field(
        default="auto",
        description="whether anything lies outside of that cube, up to 64 times as far; auto: if images have no alpha",
    )
    sizes: Literal["tiny", "cpu", "published"] = Field(
        default="cpu",
        description="sizes of networks, grids and batches: for a first try, for a CPU, or as published",
    )
    lr: float | None = Field(
        default=None,
        gt=0,
        le=1,
        description="learning rate of Adam at its height; null: 1e-2 of ngp, 1e-3 of nerf (published: 5e-4)",
    )


class NgpModel(FieldModel):
    """Instant-NGP (Müller et al. 2022) with the protocol of nerfacc's occupancy grid (Li et al.
    2023)."""

    kind: Literal["ngp"] = Field(
        default="ngp",
        description="radiance field: hash grid and small networks (Instant-NGP; docs/family.md)",
    )


class NerfModel(FieldModel):
    """NeRF (Mildenhall et al. 2020): the slow reference."""

    kind: Literal["nerf"] = Field(
        default="nerf", description="radiance field: two large networks (NeRF; docs/family.md)"
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
