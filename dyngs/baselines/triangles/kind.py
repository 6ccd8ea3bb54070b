"""The kind ``bg_triangle``: curved triangles with sharp edges."""

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
        description="curved triangles with sharp edges (BG-Triangle; docs/family.md)",
    )
    max_triangles: int = Field(
        default=4000, ge=4, le=1_000_000, description="most triangles that a run ends with"
    )
    gaussian_steps: int = Field(
        default=800,
        ge=0,
        le=100_000,
        description="steps of Gaussians whose surface triangles begin on; 0: they begin at the first points",
    )
    sh_degree: int = Field(
        default=2,
        ge=0,
        le=4,
        description="degree of the harmonics that a triangle's colours share; 0: none",
    )
    texture: int = Field(
        default=3,
        ge=1,
        le=16,
        description="segments of an edge of a triangle's texture, which is linear between them",
    )
    supersampling: int = Field(
        default=2, ge=1, le=4, description="pixels are drawn as the mean of its square"
    )


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
        from dyngs.baselines.triangles import scene, training

        return training.TriangleTraining, scene.restore_scene


BG_TRIANGLE = BgTriangleKind(BgTriangleModel)
