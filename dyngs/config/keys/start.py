"""Section ``init``: the first Gaussians."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from dyngs.core.section import Length, Section


class PointsInit(Section):
    """Start from the capture's sparse points, else from triangulated ones, else from random
    ones."""

    kind: Literal["auto", "points"] = Field(
        default="auto", description="the capture's points, else triangulated, else random ones"
    )
    triangulate: int = Field(
        default=24,
        ge=0,
        description="images of one time step to triangulate points from where the capture has none; 0: do not",
    )
    dense: int = Field(
        default=0,
        ge=0,
        description="points of depth maps, added in still captures to fewer than half as many; preset static: 10000",
    )
    num_random: int = Field(
        default=20_000, ge=1, description="number of random points; auto: where there are no others"
    )
    half_extent: Length = Field(
        default="auto",
        description="half the side of their cube around the origin (Blender scenes), in the unit of the capture; auto: "
        "a quarter of the scene extent, 1.3 in NeRF-synthetic scenes",
    )


class RandomInit(Section):
    """Start from uniformly random points in a cube around the origin (Blender scenes of 3DGS)."""

    kind: Literal["random"] = Field(
        default="random", description="points drawn uniformly in a cube around the origin"
    )
    num_random: int = Field(
        default=20_000, ge=1, description="number of random points; auto: where there are no others"
    )
    half_extent: Length = Field(
        default="auto",
        description="half the side of their cube around the origin (Blender scenes), in the unit of the capture; auto: "
        "a quarter of the scene extent, 1.3 in NeRF-synthetic scenes",
    )


class SceneInit(Section):
    """Go on from a scene that was trained before; a model of a still scene."""

    num_random: ClassVar[int] = 1
    half_extent: ClassVar[Length] = "auto"
    """Of a placeholder, where a checkpoint is read instead."""

    kind: Literal["scene"] = Field(
        default="scene", description="the Gaussians of a scene (`dyngs train --from`)"
    )
    scene: Path = Field(description="run or file of Gaussians, in the world of the capture")
    trains: Literal["all", "colour"] = Field(
        default="all",
        description="what is trained; colour: positions, shapes and opacities stay, none are added",
    )
    box: tuple[float, float, float, float, float, float] | None = Field(
        default=None,
        description="low and high corner [x,y,z,x,y,z]: what is outside stays as it is; null: nothing",
    )
