"""Section ``data``: where the images are and how they are read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from dyngs.core.section import Section


class DataConfig(Section):
    """Where the images are and how they are read."""

    root: Path = Field(description="folder or .zip of the capture")
    format: Literal[
        "auto",
        "body_json",
        "zju_mocap",
        "people_snapshot",
        "neuman",
        "blender",
        "nerfstudio",
        "colmap",
        "nerfies",
        "polycam",
        "record3d",
        "metashape",
        "realitycapture",
        "odm",
        "llff",
        "camera_folders",
    ] = Field(
        default="auto",
        description="layout of the capture's files (`dyngs docs captures`); auto: detected",
    )
    frames: str | None = Field(
        default=None,
        description="start:stop:step over the capture's times, as a Python slice; null: all",
    )
    pose_frames: str | None = Field(
        default=None,
        description="start:stop:step over the times that data.frames leaves: images of a person that are held out as "
        "the split pose; -20:: is the last 20; null: none",
    )
    train_cameras: tuple[Annotated[int, Field(ge=0)], ...] | None = Field(
        default=None,
        min_length=1,
        description="cameras whose images are trained on, by index from 0 as the capture has them; those of all "
        "others are for testing; null: as the capture says",
    )
    times: Literal["files", "order"] = Field(
        default="files",
        description="when the images were taken; files: as the capture says; order: in the order of their names, by "
        "the numbers that these end in",
    )
    frames_per_second: float | None = Field(
        default=None,
        gt=0,
        description="with times=order: so many numbers, or places in the order, are a second; null: not known",
    )
    skip_missing: bool = Field(
        default=False,
        description="leave out views whose images are missing, instead of stopping with an error",
    )
    downscale: float = Field(
        default=1.0, ge=1.0, description="divide width and height of the images by this"
    )
    longest_side: int | None = Field(
        default=None,
        ge=1,
        description="shrink images so that the longer side has at most this many px; null: do not",
    )
    test_every: int = Field(
        default=8,
        ge=0,
        description="hold out every n-th image by name where the capture has no split; 0: none",
    )
    background: Literal["auto", "white", "black", "random"] = Field(
        default="auto",
        description="colour behind the Gaussians; auto: white where the images have alpha, black otherwise; "
        "random: another one in each step",
    )
    body: Path | None = Field(
        default=None,
        description="folder of a fit by `dyngs data fit`, read in place of the capture's body parameters",
    )
    cache_mb: float = Field(default=4096, ge=0, description="memory for decoded images, MB")
    follow_links: bool = Field(
        default=False, description="allow files of the capture that lie outside its folder"
    )
