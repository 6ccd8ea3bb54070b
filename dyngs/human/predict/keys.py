"""Sections `model` of networks that predict people, and of the fields that some predict."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from dyngs.core.section import ModelSection, Positive, SceneModel


class FieldPredictorModel(ModelSection):
    """Keys that networks share which predict fields of people."""

    body: Path | None = Field(
        default=None, description="SMPL, SMPL-H or SMPL-X file; null: the free template"
    )
    source_views: int = Field(
        default=4,
        ge=2,
        le=16,
        description="images that a person is predicted from; each training example has 2 to so many",
    )
    lr: Positive = Field(default=2e-3, description="highest learning rate of AdamW (one cycle)")


class KeypointNerfModel(FieldPredictorModel):
    """KeypointNeRF (Mihajlovic et al. 2022)."""

    kind: Literal["keypoint_nerf"] = Field(
        default="keypoint_nerf",
        description="a network that predicts a field of a person, placed by key points (KeypointNeRF; "
        "`dyngs docs people`)",
    )


class EgHumanNerfModel(FieldPredictorModel):
    """EG-HumanNeRF (Wang, Kanamori and Endo 2024)."""

    kind: Literal["eg_human_nerf"] = Field(
        default="eg_human_nerf",
        description="a network that predicts a field of a person from few samples around a body (EG-HumanNeRF; "
        "`dyngs docs people`)",
    )


class PredictedFieldModel(ModelSection):
    """What such a network has predicted: not trained, but drawn like any other scene."""

    kind: Literal["predicted_field"] = Field(
        default="predicted_field",
        description="a field of a person, as `dyngs predict` writes it; it is not trained",
    )
    network: Literal["keypoint_nerf", "eg_human_nerf"] = Field(
        default="keypoint_nerf", description="what has predicted it"
    )


class GpsModel(SceneModel):
    """A network that predicts people from pairs of neighbouring views (docs/guides/people.md)."""

    kind: Literal["gps"] = Field(
        default="gps",
        description="a network that predicts people from two neighbouring views, after GPS-Gaussian "
        "(`dyngs docs people`)",
    )
    person_px: int = Field(
        default=256,
        ge=32,
        le=4096,
        description="height of the person in the rectified views, px; a Gaussian per pixel",
    )
    lr: Positive = Field(default=1e-3, description="highest learning rate of AdamW (one cycle)")
