"""Section ``model`` of the network that predicts people from pairs of views."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from dyngs.core.section import Positive, SceneModel


class GpsModel(SceneModel):
    """A network that predicts people from pairs of neighbouring views (docs/people_network.md)."""

    kind: Literal["gps"] = Field(
        default="gps",
        description="a network that predicts people from two neighbouring views, after GPS-Gaussian "
        "(docs/people_network.md)",
    )
    person_px: int = Field(
        default=256,
        ge=32,
        le=4096,
        description="height of the person in the rectified views, px; a Gaussian per pixel",
    )
    lr: Positive = Field(default=1e-3, description="highest learning rate of AdamW (one cycle)")
