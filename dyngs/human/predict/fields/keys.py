"""Sections ``model`` of the networks that predict fields of people, and of what they predict."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from dyngs.core.section import ModelSection, Positive


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
        "docs/people_network.md)",
    )


class EgHumanNerfModel(FieldPredictorModel):
    """EG-HumanNeRF (Wang, Kanamori and Endo 2024)."""

    kind: Literal["eg_human_nerf"] = Field(
        default="eg_human_nerf",
        description="a network that predicts a field of a person from few samples around a body (EG-HumanNeRF; "
        "docs/people_network.md)",
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
