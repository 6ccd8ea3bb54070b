"""Model kinds of networks that predict people, and of the fields that some predict."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from dyngs.core.section import ModelSection
from dyngs.human.keys import HumanPredictorModel
from dyngs.human.predict.keys import (
    EgHumanNerfModel,
    GpsModel,
    KeypointNerfModel,
    PredictedFieldModel,
)
from dyngs.models.kind import ModelKind, PredictsScenes

if TYPE_CHECKING:
    from dyngs.data.capture import Capture
    from dyngs.models.kind import MakeLearner, MakePredictor, Restore, Start


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
