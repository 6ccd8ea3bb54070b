"""All sections together: ``Config``, everything that decides a run."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from dyngs.config.keys.budget import BudgetConfig
from dyngs.config.keys.camera import CameraConfig
from dyngs.config.keys.colour import AutoColour, NetworkColour, ShColour
from dyngs.config.keys.data import DataConfig
from dyngs.config.keys.dynamic import DynamicModel
from dyngs.config.keys.human import HumanModel, HumanPredictorModel
from dyngs.config.keys.model import StaticModel
from dyngs.config.keys.prune import PruneConfig
from dyngs.config.keys.run import RunConfig
from dyngs.config.keys.section import Section
from dyngs.config.keys.start import PointsInit, RandomInit
from dyngs.config.keys.strategy import DefaultStrategy, OptimConfig, Strategy
from dyngs.config.keys.train import TrainConfig


class Config(Section):
    """Everything that decides a run."""

    data: DataConfig
    camera: CameraConfig = CameraConfig()
    model: Annotated[
        StaticModel | DynamicModel | HumanModel | HumanPredictorModel,
        Field(discriminator="kind", description="what is trained"),
    ] = StaticModel()
    init: Annotated[
        PointsInit | RandomInit, Field(discriminator="kind", description="where the first Gaussians come from")
    ] = PointsInit()
    colour: Annotated[
        ShColour | NetworkColour | AutoColour, Field(discriminator="kind", description="what colours are made of")
    ] = ShColour()
    strategy: Annotated[
        Strategy,
        Field(discriminator="kind", description="how Gaussians are added and removed during training"),
    ] = DefaultStrategy()
    optim: OptimConfig = OptimConfig()
    train: TrainConfig = TrainConfig()
    prune: PruneConfig = PruneConfig()
    budget: BudgetConfig = BudgetConfig()
    run: RunConfig = RunConfig()

    @property
    def total_steps(self) -> int:
        """Steps of training and of the last stage, if there is one."""
        return self.train.steps + (self.prune.steps if self.prune.is_wanted and self.model.made_of_gaussians else 0)

    @property
    def stored_sh_degree(self) -> int:
        """Degree of the harmonics that training begins with."""
        return self.colour.stored_degree(self.model.sh_degree)
