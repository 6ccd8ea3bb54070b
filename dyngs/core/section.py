"""The base classes of all sections of the configuration, and ranges of numbers that several of them
use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

from dyngs.core.conventions import RasterizeMode

Positive = Annotated[float, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Length = Annotated[float, Field(gt=0, le=1e9)] | Literal["auto"]
"""A number in the unit of the capture, or a fraction of the scene extent."""
CutOff = Annotated[float, Field(ge=1e-6, le=0.5)]
"""Opacity or transmittance below which the rasterizer stops."""


class Section(BaseModel):
    """Base of every section: immutable, unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ModelSection(Section):
    """Base of the sections of all kinds, with what code that does not otherwise care for kinds asks
    of them.

    Attributes:
        made_of_gaussians: it has Gaussians, which a strategy adds and limits remove.
        begins_with_points: they begin where the points of the capture are.
        is_network: it predicts scenes, and is trained on several captures.
        is_posed: a body moves it: priors on motion say nothing, and poses are refined instead of
            cameras.
        source_views: images that a network predicts from, unless it is told otherwise.
        may_move: a field moves it over the times of the capture.
        draws_whole_images: in training; what needs these (priors, masks of what disagrees, refined
            cameras, exposures) does not go with a model that draws some pixels of an image.
        is_trained: not only predicted, so that a run may be unfinished.
    """

    made_of_gaussians: ClassVar[bool] = False
    begins_with_points: ClassVar[bool] = False
    is_network: ClassVar[bool] = False
    is_posed: ClassVar[bool] = False
    may_move: ClassVar[bool] = False
    draws_whole_images: ClassVar[bool] = True
    is_trained: ClassVar[bool] = True
    if TYPE_CHECKING:
        kind: Any = None
        """Name of the kind."""
        source_views: Any = 0
        lr: Any = 0.0

    @property
    def added_for_motion(self) -> int:
        """Number of random Gaussians that are added where motion begins."""
        return 0

    @property
    def moving_bytes(self) -> int:
        """Bytes of memory of a Gaussian in training next to its own values, where it moves."""
        return 0

    def size_key(self, count: int) -> tuple[str, float, float]:
        """Return the key that limits the number of Gaussians, its value at ``count`` of them, and
        the power of the number with which that goes."""
        return "strategy.max_gaussians", count, 1.0

    def moves_after(self, steps: int) -> int | None:
        """Return the last step without motion in a run of ``steps``; None: nothing moves."""
        return None


class SceneModel(ModelSection):
    """Keys that all models of Gaussians share: how these are coloured and drawn."""

    made_of_gaussians: ClassVar[bool] = True

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
