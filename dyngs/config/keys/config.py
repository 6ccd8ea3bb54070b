"""All sections together: ``Config``, everything that decides a run."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from dyngs.config.keys.budget import BudgetConfig
from dyngs.config.keys.colour import AutoColour, DcacColour, ShColour
from dyngs.config.keys.data import DataConfig
from dyngs.config.keys.dynamic import DynamicModel
from dyngs.config.keys.human import HumanModel, HumanNetModel
from dyngs.config.keys.model import StaticModel
from dyngs.config.keys.prune import CompactConfig
from dyngs.config.keys.run import RunConfig
from dyngs.config.keys.section import Section
from dyngs.config.keys.start import PointsInit, RandomInit
from dyngs.config.keys.strategy import DefaultStrategy, McmcStrategy, OptimConfig
from dyngs.config.keys.train import TrainConfig


class Config(Section):
    """Everything that decides a run."""

    data: DataConfig
    model: Annotated[
        StaticModel | DynamicModel | HumanModel | HumanNetModel,
        Field(discriminator="kind", description="what is trained"),
    ] = StaticModel()
    init: Annotated[
        PointsInit | RandomInit, Field(discriminator="kind", description="where the first Gaussians come from")
    ] = PointsInit()
    colour: Annotated[
        ShColour | DcacColour | AutoColour, Field(discriminator="kind", description="what colours are made of")
    ] = ShColour()
    strategy: Annotated[
        DefaultStrategy | McmcStrategy,
        Field(discriminator="kind", description="how Gaussians are added and removed during training"),
    ] = DefaultStrategy()
    optim: OptimConfig = OptimConfig()
    train: TrainConfig = TrainConfig()
    compact: CompactConfig = CompactConfig()
    budget: BudgetConfig = BudgetConfig()
    run: RunConfig = RunConfig()

    @property
    def total_steps(self) -> int:
        """Steps of training and of the last stage, if there is one."""
        compacts = self.compact.is_wanted and not isinstance(self.model, HumanNetModel)
        return self.train.steps + (self.compact.steps if compacts else 0)
