"""Typed configuration of a run, with YAML presets and overrides."""

from dyngs.config.keys.colour import AutoColour, ColourSection, NetworkColour, ShColour
from dyngs.config.keys.config import BudgetConfig, CameraConfig, Config, PruneConfig, RunConfig
from dyngs.config.keys.data import DataConfig
from dyngs.config.keys.start import PointsInit, RandomInit, SceneInit
from dyngs.config.keys.strategy import (
    DefaultStrategy,
    FixedStrategy,
    McmcStrategy,
    OptimConfig,
    Strategy,
)
from dyngs.config.keys.train import TrainConfig
from dyngs.core.section import CutOff, Fraction, ModelSection, Positive, SceneModel, Section

__all__ = [
    "AutoColour",
    "BudgetConfig",
    "CameraConfig",
    "ColourSection",
    "Config",
    "CutOff",
    "DataConfig",
    "DefaultStrategy",
    "FixedStrategy",
    "Fraction",
    "McmcStrategy",
    "ModelSection",
    "NetworkColour",
    "OptimConfig",
    "PointsInit",
    "Positive",
    "PruneConfig",
    "RandomInit",
    "RunConfig",
    "SceneInit",
    "SceneModel",
    "Section",
    "ShColour",
    "Strategy",
    "TrainConfig",
]
