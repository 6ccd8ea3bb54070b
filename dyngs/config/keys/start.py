"""Section ``init``: the initial Gaussians."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from dyngs.core.section import Length, Section


class PointsInit(Section):
    """Initial Gaussians at the sparse points of the capture, else at triangulated or random
    points."""

    kind: Literal["auto", "points"] = Field(
        default="auto",
        description="sparse points of the capture, else triangulated points, else random points",
    )
    triangulate: int = Field(
        default=24,
        ge=0,
        description="number of images of one time step from which initial points are triangulated "
        "if the capture has none; 0: no triangulation",
    )
    dense: int = Field(
        default=0,
        ge=0,
        description="number of points from depth maps, added in static captures with fewer than "
        "half as many sparse points; preset static: 10000",
    )
    num_random: int = Field(
        default=20_000,
        ge=1,
        description="number of random points; with kind=auto used only without other points",
    )
    half_extent: Length = Field(
        default="auto",
        description="half the side length of the cube of random points, in the unit of the capture; "
        "auto: a quarter of the scene extent, 1.3 in NeRF-synthetic scenes",
    )


class RandomInit(Section):
    """Initial Gaussians at random points in a cube around the origin (Blender scenes of 3DGS)."""

    kind: Literal["random"] = Field(
        default="random", description="uniformly random points in a cube around the origin"
    )
    num_random: int = Field(
        default=20_000,
        ge=1,
        description="number of random points; with kind=auto used only without other points",
    )
    half_extent: Length = Field(
        default="auto",
        description="half the side length of the cube of random points, in the unit of the capture; "
        "auto: a quarter of the scene extent, 1.3 in NeRF-synthetic scenes",
    )


class SceneInit(Section):
    """Initial Gaussians from an existing static scene."""

    num_random: ClassVar[int] = 1
    half_extent: ClassVar[Length] = "auto"
    """Unused; ``num_random`` and ``half_extent`` only size the placeholder of a restored run."""

    kind: Literal["scene"] = Field(
        default="scene", description="Gaussians of an existing scene (`dyngs train --from`)"
    )
    scene: Path = Field(
        description="run folder or file of Gaussians, in the coordinates of the capture"
    )
    trainable: Literal["all", "colour"] = Field(
        default="all",
        description="parameters to train; colour: positions, shapes and opacities are frozen and "
        "no Gaussians are added",
    )
    box: tuple[float, float, float, float, float, float] | None = Field(
        default=None,
        description="box [x,y,z,x,y,z] of the lowest and highest corner; Gaussians outside are "
        "frozen; null: all are trained",
    )
