"""Section ``model`` of static scenes."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from dyngs.core.section import SceneModel


class StaticModel(SceneModel):
    """3D Gaussian splatting, Mip-Splatting's filters as options."""

    kind: Literal["static"] = Field(
        default="static", description="3D Gaussians of a static scene (3DGS)"
    )
