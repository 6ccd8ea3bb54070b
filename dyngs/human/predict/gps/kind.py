"""The kind ``gps``: a network that predicts people from two neighbouring views."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dyngs.human.predict.gps.keys import GpsModel
from dyngs.models.kind import Predicts

if TYPE_CHECKING:
    from dyngs.models.kind import MakeLearner, MakePredictor


class GpsKind(Predicts):
    """See the module."""

    def num_views(self, section: GpsModel) -> int:
        return 2

    def networks(self) -> tuple[MakeLearner, MakePredictor]:
        from dyngs.human.predict.gps.learner import learner, predictor

        return learner, predictor


GPS = GpsKind(GpsModel)
