"""The configuration of a run: typed keys (``keys``), YAML files and overrides (``io``), keys in words (``schema``)."""

from dyngs.config.keys.budget import BudgetConfig
from dyngs.config.keys.camera import CameraConfig
from dyngs.config.keys.colour import AutoColour, ColourSection, NetworkColour, ShColour
from dyngs.config.keys.config import Config
from dyngs.config.keys.data import DataConfig
from dyngs.config.keys.dynamic import (
    ControlNodesField,
    DeformField,
    DynamicModel,
    FieldSection,
    HexplaneField,
    MlpField,
    TrajectoryField,
)
from dyngs.config.keys.human import HumanModel, HumanPredictorModel
from dyngs.config.keys.model import ModelSection, SceneModel, StaticModel
from dyngs.config.keys.prune import PruneConfig
from dyngs.config.keys.run import RunConfig
from dyngs.config.keys.section import CutOff, Fraction, Positive, Section
from dyngs.config.keys.start import PointsInit, RandomInit
from dyngs.config.keys.strategy import DefaultStrategy, FixedStrategy, McmcStrategy, OptimConfig, Strategy
from dyngs.config.keys.train import TrainConfig

__all__ = [
    "AutoColour",
    "BudgetConfig",
    "CameraConfig",
    "ColourSection",
    "Config",
    "ControlNodesField",
    "CutOff",
    "DataConfig",
    "DefaultStrategy",
    "DeformField",
    "DynamicModel",
    "FieldSection",
    "FixedStrategy",
    "Fraction",
    "HexplaneField",
    "HumanModel",
    "HumanPredictorModel",
    "McmcStrategy",
    "MlpField",
    "ModelSection",
    "NetworkColour",
    "OptimConfig",
    "PointsInit",
    "Positive",
    "PruneConfig",
    "RandomInit",
    "RunConfig",
    "SceneModel",
    "Section",
    "ShColour",
    "StaticModel",
    "Strategy",
    "TrainConfig",
    "TrajectoryField",
]
