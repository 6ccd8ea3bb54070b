"""Model kinds of networks that predict people, and of the fields that some predict."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from dyngs.core.section import Fraction, ModelSection, Positive, SceneModel
from dyngs.human.keys import HumanPredictorModel
from dyngs.models.kind import ModelKind, PredictsScenes

if TYPE_CHECKING:
    from dyngs.data.capture import Capture
    from dyngs.models.kind import MakeLearner, MakePredictor, Restore, Start


class FieldKeys(ModelSection):
    """Keys that decide how a field of a person is rendered."""

    supersampling: int = Field(
        default=1,
        ge=1,
        le=4,
        description="rays per pixel and axis; 2 renders soft outlines at four times the cost",
    )


class FieldPredictorModel(FieldKeys):
    """Keys of networks that predict a radiance field of a person."""

    body: Path | None = Field(
        default=None, description="SMPL, SMPL-H or SMPL-X file; null: the free template"
    )
    source_views: int = Field(
        default=4,
        ge=2,
        le=16,
        description="input images per person; training examples have 2 to this number",
    )
    patch: int = Field(
        default=32,
        ge=8,
        description="side of the image patch of a training step, px; KeypointNeRF: 64",
    )
    lr: Positive = Field(
        default=2e-3, description="peak learning rate of AdamW (one-cycle schedule)"
    )


class KeypointNerfModel(FieldPredictorModel):
    """KeypointNeRF (Mihajlovic et al. 2022)."""

    kind: Literal["keypoint_nerf"] = Field(
        default="keypoint_nerf",
        description="network that predicts a radiance field of a person from images and key "
        "points (KeypointNeRF; `dyngs docs people`)",
    )


class EgHumanNerfModel(FieldPredictorModel):
    """EG-HumanNeRF (Wang, Kanamori and Endo 2024)."""

    kind: Literal["eg_human_nerf"] = Field(
        default="eg_human_nerf",
        description="network that predicts a radiance field of a person with few samples around a "
        "body (EG-HumanNeRF; `dyngs docs people`)",
    )


class PredictedFieldModel(FieldKeys):
    """Radiance field predicted by such a network; it is rendered but not trained."""

    kind: Literal["predicted_field"] = Field(
        default="predicted_field",
        description="radiance field of a person, as written by `dyngs predict`; it is not trained",
    )
    network: Literal["keypoint_nerf", "eg_human_nerf"] = Field(
        default="keypoint_nerf", description="network that predicted it"
    )


class GpsModel(SceneModel):
    """Network that predicts people from pairs of neighbouring views (`dyngs docs people`)."""

    kind: Literal["gps"] = Field(
        default="gps",
        description="network that predicts people from two neighbouring views, after GPS-Gaussian "
        "(`dyngs docs people`)",
    )
    person_px: int = Field(
        default=256,
        ge=32,
        le=4096,
        description="height of the person in the rectified views, px; one Gaussian per pixel",
    )
    matching: Literal["cost_volume", "recurrent"] = Field(
        default="cost_volume",
        description="how disparities are estimated; cost_volume: one correction of compared "
        "colours and silhouettes; recurrent: repeated updates from correlated features, as in "
        "GPS-Gaussian, slower",
    )
    updates: int = Field(
        default=3,
        ge=1,
        le=64,
        description="updates of each disparity, matching=recurrent only; more are slower",
    )
    channels: int = Field(
        default=96,
        ge=24,
        le=768,
        multiple_of=24,
        description="channels of matching features and hidden state, "
        "matching=recurrent only; fewer are faster",
    )
    consistency_weight: float = Field(
        default=0.1,
        ge=0,
        description="weight of the disparity by which a surface of one view hides that of the "
        "other view, matching=recurrent only",
    )
    depth_fraction: Fraction = Field(
        default=0.4,
        description="fraction of the training steps that train disparity only, before images",
    )
    lr: Positive = Field(
        default=1e-3, description="peak learning rate of AdamW (one-cycle schedule)"
    )


class PersonPredictorKind(PredictsScenes):
    """Predicts people by the network of a ``module`` of this package."""

    def __init__(self, section: type[ModelSection], module: str) -> None:
        super().__init__(section)
        self._module = module

    def num_views(self, section: ModelSection) -> int:
        return getattr(section, "source_views", 2)

    def networks(self) -> tuple[MakeLearner, MakePredictor]:
        module = import_module(f"dyngs.human.predict.{self._module}")
        return module.learner, module.predictor


class PredictedFieldKind(ModelKind):
    """Predicted radiance fields: rendered, not trained."""

    def refusal(self, capture: Capture) -> str:
        return "model.kind=predicted_field is written by `dyngs predict` and cannot be trained"

    def functions(self) -> tuple[Start, Restore]:
        from dyngs.human.predict.fields.prediction import PredictedModel, restore

        return PredictedModel, restore


HUMAN_PREDICTOR = PersonPredictorKind(HumanPredictorModel, "ghg.network")  # GHG
GPS = PersonPredictorKind(GpsModel, "gps.stereo")  # GPS-Gaussian, from pairs of views
KEYPOINT_NERF = PersonPredictorKind(KeypointNerfModel, "fields.prediction")
EG_HUMAN_NERF = PersonPredictorKind(EgHumanNerfModel, "fields.prediction")
PREDICTED_FIELD = PredictedFieldKind(PredictedFieldModel)
