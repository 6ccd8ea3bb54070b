"""The base classes of all sections of the configuration, and ranges of numbers that several of them
use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from dyngs.core.conventions import RasterizeMode

Positive = Annotated[float, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Length = Annotated[float, Field(gt=0, le=1e9)] | Literal["auto"]
"""A number in the unit of the capture, or a fraction of the scene extent."""
CutOff = Annotated[float, Field(ge=1e-6, le=0.5)]
"""Opacity or transmittance below which the rasterizer stops."""


def parse_digits(value: object) -> object:
    """Return the number that a text of digits is, for choices between numbers."""
    return int(value) if isinstance(value, str) and value.isdecimal() else value


class Section(BaseModel):
    """Base of every section: immutable, unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*")
    @classmethod
    def _require_countable(cls, value: object) -> object:
        if isinstance(value, int) and abs(value) >= 2**63:
            raise ValueError("must be below 2^63")
        return value


class ModelSection(Section):
    """Base of the section ``model`` of every kind."""

    if TYPE_CHECKING:
        kind: Any = None
        """Name of the kind."""

    @property
    def num_added_for_motion(self) -> int:
        """Number of Gaussians that are added when motion begins."""
        return 0

    @property
    def bytes_per_moving_gaussian(self) -> int:
        """Bytes of memory of a Gaussian in training next to its own values, where it moves."""
        return 0

    def size_key(self, count: int) -> tuple[str, float, float]:
        """Return the key that limits the number of Gaussians, its value at ``count`` of them, and
        the power of the number with which that goes."""
        return "strategy.max_gaussians", count, 1.0

    def motion_start_step(self, steps: int) -> int | None:
        """Return the last step without motion in a run of ``steps``; None: nothing moves."""
        return None


class SceneModel(ModelSection):
    """Keys that all models of Gaussians share: how these are coloured and drawn."""

    sh_degree: int = Field(
        default=3,
        ge=0,
        le=4,
        description="degree of the spherical harmonics of a colour; 0: the same from all sides",
    )
    rasterize_mode: RasterizeMode = Field(
        default=RasterizeMode.CLASSIC,
        description="classic: 3DGS; antialiased: opacity makes up for the low-pass filter (2D filter of Mip-Splatting)",
    )
    eps2d: float = Field(
        default=0.3,
        ge=0,
        le=3.4e38,
        description="variance of the 2D low-pass filter, px^2; Mip-Splatting: 0.1 with antialiased",
    )
    filter_3d: bool = Field(
        default=False, description="3D smoothing filter of Mip-Splatting (Yu et al. 2024)"
    )
    near: Length = Field(
        default="auto",
        description="near plane, in the unit of the capture; auto: a fraction of the scene extent",
    )
    alpha_min: CutOff = Field(
        default=1 / 255,
        description="a pixel skips Gaussians with an alpha below this there; 1/255 in 3DGS",
    )
    transmittance_min: CutOff = Field(
        default=1e-4,
        description="blending of a pixel ends when its transmittance falls below this; 1e-4 in 3DGS",
    )
