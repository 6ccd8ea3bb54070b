"""Model kind ``bg_triangle``: curved triangles with sharp edges."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from dyngs.core.section import ModelSection
from dyngs.models.kind import ModelKind

if TYPE_CHECKING:
    from dyngs.models.kind import Restore, Start


class BgTriangleModel(ModelSection):
    """BG-Triangle (Wu et al. 2025)."""

    kind: Literal["bg_triangle"] = Field(
        default="bg_triangle",
        description="curved triangles with sharp edges (BG-Triangle)",
    )
    max_triangles: int = Field(
        default=4000, ge=4, le=1_000_000, description="maximum number of triangles"
    )
    gaussian_steps: int = Field(
        default=800,
        ge=0,
        le=100_000,
        description="steps of Gaussian training whose surface initialises the triangles; 0: start at points",
    )
    sh_degree: int = Field(
        default=2,
        ge=0,
        le=4,
        description="degree of the spherical harmonics of a triangle; 0: none",
    )
    texture: int = Field(
        default=3,
        ge=1,
        le=16,
        description="segments per edge of a triangle's texture, with linear interpolation",
    )
    supersampling: int = Field(
        default=2,
        ge=1,
        le=4,
        description="pixels of faces are the mean of this number squared of samples",
    )
    primitives: Literal["faces", "gaussians"] = Field(
        default="faces",
        description="faces: opaque, with anti-aliased outlines; gaussians: one Gaussian at each "
        "pixel's point on the surface, splatted, as published",
    )
    gaussian_size: float = Field(
        default=2.0,
        gt=0,
        le=100,
        description="with model.primitives=gaussians, standard deviation of Gaussians before "
        "textures, pixels at the centre of the scene; as published about 2 at 800 px, 1 at 400 px",
    )
    boundary_weights: bool = Field(
        default=True,
        description="with model.primitives=gaussians, fade a triangle's Gaussians within two "
        "pixels of its outline until textures are trained",
    )


class BgTriangleKind(ModelKind):
    """BG-Triangle."""

    uses = ModelKind.uses | {
        "init",
        "train.exposure",
        "train.robust",
        "train.priors",
        "budget.max_mb",
    }

    def functions(self) -> tuple[Start, Restore]:
        from dyngs.baselines.triangles import scene, training

        return training.TriangleTraining, scene.restore_scene


BG_TRIANGLE = BgTriangleKind(BgTriangleModel)
