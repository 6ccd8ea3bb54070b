"""Sections ``model`` of radiance fields."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from dyngs.core.section import ModelSection, Positive, as_number


class FieldModel(ModelSection):
    """Keys that all fields share."""

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
    lr: Positive = Field(default=1e-2, le=1, description="learning rate of Adam at its height")


class NgpModel(FieldModel):
    """Instant-NGP (Müller et al. 2022) with the protocol of nerfacc's occupancy grid (Li et al.
    2023)."""

    kind: Literal["ngp"] = Field(
        default="ngp",
        description="radiance field: hash grid and small networks (Instant-NGP; docs/family.md)",
    )
    sizes: Literal["cpu", "published"] = Field(
        default="cpu",
        description="what the sizes below are unless given: 8 levels of 2^16 rows of 4 and 2^14 samples, or "
        "16 of 2^19 of 2 and 2^18",
    )
    levels: int | None = Field(default=None, ge=1, le=32, description="levels of the hash grid")
    features: Annotated[Literal[1, 2, 4, 8] | None, BeforeValidator(as_number)] = Field(
        default=None, description="features per level"
    )
    log2_rows: int | None = Field(
        default=None, ge=4, le=24, description="most rows of a level, as a power of two"
    )
    finest: int | None = Field(
        default=None,
        ge=16,
        le=2**17,
        description="cells of the finest level along an axis; null: 2.56 per pixel of an image's longest side, twice "
        "as many with surroundings, or 4096 as published",
    )
    log2_samples: int | None = Field(
        default=None,
        ge=8,
        le=22,
        description="samples per step, as a power of two; the number of rays follows",
    )
    cells: int | None = Field(
        default=None,
        ge=8,
        le=512,
        description="cells of the occupancy grid along an axis of each cube; null: 128, 64 with surroundings",
    )
    weight_decay: float = Field(
        default=1e-6, ge=0, description="L2 penalty of the networks' weights, in Adam"
    )


class NerfModel(FieldModel):
    """NeRF (Mildenhall et al. 2020): the slow reference."""

    kind: Literal["nerf"] = Field(
        default="nerf", description="radiance field: two large networks (NeRF; docs/family.md)"
    )
    lr: Positive = Field(default=5e-4, le=1, description="learning rate of Adam at its height")
    width: int = Field(default=256, ge=8, le=1024, description="features of the hidden layers")
    coarse: int = Field(
        default=64, ge=4, le=1024, description="samples of a ray for the coarse network"
    )
    fine: int = Field(
        default=128, ge=4, le=1024, description="more samples of a ray for the fine network"
    )
    rays: int = Field(default=1024, ge=1, le=2**16, description="rays per step")
