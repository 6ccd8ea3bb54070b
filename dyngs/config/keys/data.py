"""Section ``data``: location and reading of the capture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, cast

from pydantic import (
    Field,
    PlainSerializer,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    field_validator,
    model_validator,
)

from dyngs.core.plugins import READERS, plugin_entries
from dyngs.core.section import Section


def _or_plugin(value: object, check: ValidatorFunctionWrapHandler) -> object:
    """Allow the names of installed readers beside the built-in ones."""
    try:
        return check(value)
    except ValidationError:
        if value in plugin_entries(READERS):
            return value
        raise


class DataConfig(Section):
    """Location and reading of the capture."""

    root: Path = Field(description="folder or .zip of the capture")
    format: Annotated[
        Literal[
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
        ],
        WrapValidator(_or_plugin),
        PlainSerializer(str),
    ] = Field(
        default="auto",
        description="format of the capture, also that of a plug-in; auto: detected from its files",
    )
    frames: str | None = Field(
        default=None,
        description="time steps to use, as a Python slice start:stop:step; null: all",
    )
    person: int | None = Field(
        default=None,
        ge=1,
        description="number of the person in a clip of several people, as `dyngs data people` "
        "lists them; null: the one who is seen largest and longest",
    )
    stature: float | None = Field(
        default=None,
        ge=0.3,
        le=3.0,
        description="height of the person, m, for a clip of one fixed camera, which does not show "
        "the size; null: 1.70",
    )
    pose_frames: str | None = Field(
        default=None,
        description="time steps of a person to hold out as the split pose, as a slice of those "
        "that data.frames selects; -20:: for the last 20; null: none",
    )
    train_cameras: tuple[Annotated[int, Field(ge=0)], ...] | None = Field(
        default=None,
        min_length=1,
        description="indices of the training cameras, from 0; all other cameras become test "
        "cameras; null: the split of the capture",
    )
    times: Literal["files", "order"] = Field(
        default="files",
        description="source of the image times; files: stored in the capture; order: the numbers "
        "at the end of the image names",
    )
    frames_per_second: float | None = Field(
        default=None,
        gt=0,
        description="frame rate of the numbered images with times=order; null: unknown",
    )
    skip_missing: bool = Field(
        default=False,
        description="whether to skip views whose images are missing instead of raising an error",
    )
    downscale: float = Field(
        default=1.0, ge=1.0, description="factor by which image width and height are divided"
    )
    longest_side: int | None = Field(
        default=1600,
        ge=0,
        description="maximum length of the longer image side, px; larger images are downscaled; "
        "0 or null: no limit, which is also the default if data.downscale is given",
    )
    test_every: int = Field(
        default=8,
        ge=0,
        description="hold out every n-th image, sorted by name, if the capture defines no split; "
        "0: none",
    )
    test_first: int | None = Field(
        default=None,
        ge=0,
        description="index of the first image that data.test_every holds out; null: in the middle "
        "of the first n images if they have times, so that the ends of a clip are trained on, "
        "else 0",
    )
    background: Literal["auto", "white", "black", "random"] = Field(
        default="auto",
        description="background colour; auto: white if the images have alpha, else black; "
        "random: a new random colour in each step",
    )
    body: Path | None = Field(
        default=None,
        description="output folder of `dyngs data fit` whose body parameters replace those of the "
        "capture",
    )
    cache_mb: float = Field(default=4096, ge=0, description="size of the image cache, MB")
    follow_links: bool = Field(
        default=False,
        description="whether to follow links to files outside the folder of the capture",
    )

    @model_validator(mode="before")
    @classmethod
    def _keep_requested_downscale(cls, given: object) -> object:
        """Remove the default limit on the image size if ``downscale`` determines the size."""
        if not isinstance(given, dict):
            return given
        values = cast("dict[str, Any]", given)
        return {"longest_side": None, **values} if "downscale" in values else values

    @field_validator("longest_side")
    @classmethod
    def _read_no_limit(cls, value: int | None) -> int | None:
        return value or None
