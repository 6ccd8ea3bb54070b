"""The configuration of a run: typed keys (``keys``), YAML files and overrides (``io``), keys in words (``schema``)."""

from dyngs.config.keys.budget import BudgetConfig
from dyngs.config.keys.colour import AutoColour, ColourSection, DcacColour, ShColour
from dyngs.config.keys.config import Config
from dyngs.config.keys.data import DataConfig
from dyngs.config.keys.dynamic import (
    DeformField,
    DynamicModel,
    FieldSection,
    HexplaneField,
    MlpField,
    SkeletonField,
    TrajectoryField,
)
from dyngs.config.keys.human import HumanModel, HumanNetModel
from dyngs.config.keys.model import SceneModel, StaticModel
from dyngs.config.keys.prune import CompactConfig
from dyngs.config.keys.run import RunConfig
from dyngs.config.keys.section import CutOff, Fraction, Positive, Section
from dyngs.config.keys.start import PointsInit, RandomInit
from dyngs.config.keys.strategy import DefaultStrategy, McmcStrategy, OptimConfig
from dyngs.config.keys.train import TrainConfig

__all__ = [
    "AutoColour",
    "BudgetConfig",
    "ColourSection",
    "CompactConfig",
    "Config",
    "CutOff",
    "DataConfig",
    "DcacColour",
    "DefaultStrategy",
    "DeformField",
    "DynamicModel",
    "FieldSection",
    "Fraction",
    "HexplaneField",
    "HumanModel",
    "HumanNetModel",
    "McmcStrategy",
    "MlpField",
    "OptimConfig",
    "PointsInit",
    "Positive",
    "RandomInit",
    "RunConfig",
    "SceneModel",
    "Section",
    "ShColour",
    "SkeletonField",
    "StaticModel",
    "TrainConfig",
    "TrajectoryField",
]
