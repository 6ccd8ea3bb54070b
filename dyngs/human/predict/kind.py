"""Model kinds of networks that predict people, and of the fields that some predict."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dyngs.human.keys import HumanPredictorModel
from dyngs.human.predict.keys import (
    EgHumanNerfModel,
    FieldPredictorModel,
    GpsModel,
    KeypointNerfModel,
    PredictedFieldModel,
)
from dyngs.models.kind import ModelKind, PredictsScenes

if TYPE_CHECKING:
    from dyngs.data.capture import Capture
    from dyngs.models.kind import MakeLearner, MakePredictor, Restore, Start


class HumanPredictorKind(PredictsScenes):
    """Predicts avatars on a body template (GHG)."""

    def num_views(self, section: HumanPredictorModel) -> int:
        return section.source_views

    def networks(self) -> tuple[MakeLearner, MakePredictor]:
        from dyngs.human.predict.ghg.network import learner, predictor

        return learner, predictor


HUMAN_PREDICTOR = HumanPredictorKind(HumanPredictorModel)


class GpsKind(PredictsScenes):
    """Predicts Gaussians from pairs of views (GPS-Gaussian)."""

    def num_views(self, section: GpsModel) -> int:
        return 2

    def networks(self) -> tuple[MakeLearner, MakePredictor]:
        from dyngs.human.predict.gps.stereo import learner, predictor

        return learner, predictor


GPS = GpsKind(GpsModel)


class FieldPredictorKind(PredictsScenes):
    """Predicts radiance fields (KeypointNeRF, EG-HumanNeRF)."""

    def num_views(self, section: FieldPredictorModel) -> int:
        return section.source_views

    def networks(self) -> tuple[MakeLearner, MakePredictor]:
        from dyngs.human.predict.fields.prediction import learner, predictor

        return learner, predictor


class PredictedFieldKind(ModelKind):
    """Predicted radiance fields: rendered, not trained."""

    def refusal(self, capture: Capture) -> str:
        return "model.kind=predicted_field is written by `dyngs predict` and cannot be trained"

    def functions(self) -> tuple[Start, Restore]:
        from dyngs.human.predict.fields.prediction import PredictedModel, restore

        return PredictedModel, restore


KEYPOINT_NERF = FieldPredictorKind(KeypointNerfModel)
EG_HUMAN_NERF = FieldPredictorKind(EgHumanNerfModel)
PREDICTED_FIELD = PredictedFieldKind(PredictedFieldModel)
