"""The kind ``human_predictor``: a network that predicts people from a few images (GHG)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dyngs.human.keys import HumanPredictorModel
from dyngs.models.kind import Predicts

if TYPE_CHECKING:
    from dyngs.models.kind import MakeLearner, MakePredictor


class HumanPredictorKind(Predicts):
    """See the module."""

    def num_views(self, section: HumanPredictorModel) -> int:
        return section.source_views

    def networks(self) -> tuple[MakeLearner, MakePredictor]:
        from dyngs.human.predict.ghg.learner import learner, predictor

        return learner, predictor


HUMAN_PREDICTOR = HumanPredictorKind(HumanPredictorModel)
