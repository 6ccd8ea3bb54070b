"""Section ``camera``: whether the cameras of a capture are taken as they are."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from dyngs.config.keys.section import Section


class CameraConfig(Section):
    """Whether the cameras of a capture are taken as they are."""

    refine: Literal["never", "auto", "always"] = Field(
        default="never",
        description="correct poses, focal lengths and principal points of the training views while the scene is "
        "trained; not of people; auto: where two small runs beforehand say that it pays",
    )
