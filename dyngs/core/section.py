"""Base classes of the configuration sections, and number ranges that several of them use."""

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
    """Convert a text of digits to int, for ``Literal`` choices between integers."""
    return int(value) if isinstance(value, str) and value.isdecimal() else value


class Section(BaseModel):
    """Base class of all sections: immutable, unknown keys are errors."""

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
        """Number of Gaussians added at the step where motion starts."""
        return 0

    @property
    def bytes_per_moving_gaussian(self) -> int:
        """Additional training memory of a moving Gaussian, bytes."""
        return 0

    def size_key(self, count: int) -> tuple[str, float, float]:
        """Return the key that limits the number of Gaussians, its value for ``count`` Gaussians,
        and the exponent with which the value grows with the number."""
        return "strategy.max_gaussians", count, 1.0

    def motion_start_step(self, steps: int) -> int | None:
        """Return the last static step in a run of ``steps``; None for a static model."""
        return None


class SceneModel(ModelSection):
    """Keys shared by all models of Gaussians: colour and rasterization."""

    sh_degree: int = Field(
        default=3,
        ge=0,
        le=4,
        description="degree of the spherical harmonics; 0: view-independent colours",
    )
    rasterize_mode: RasterizeMode = Field(
        default=RasterizeMode.CLASSIC,
        description="how the 2D low-pass filter treats opacity; classic: unchanged (3DGS); "
        "antialiased: scaled to compensate for the filter (2D filter of Mip-Splatting)",
    )
    eps2d: float = Field(
        default=0.3,
        ge=0,
        le=3.4e38,
        description="variance of the 2D low-pass filter, px^2; Mip-Splatting uses 0.1 with antialiased",
    )
    filter_3d: bool = Field(
        default=False,
        description="whether to apply the 3D smoothing filter of Mip-Splatting (Yu et al. 2024)",
    )
    near: Length = Field(
        default="auto",
        description="distance of the near plane, in the unit of the capture; "
        "auto: a fraction of the scene extent",
    )
    alpha_min: CutOff = Field(
        default=1 / 255,
        description="alpha below which a Gaussian is not blended into a pixel; 3DGS: 1/255",
    )
    transmittance_min: CutOff = Field(
        default=1e-4,
        description="transmittance below which blending of a pixel stops; 3DGS: 1e-4",
    )
