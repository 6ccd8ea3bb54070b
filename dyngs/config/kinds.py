"""Facts about a configuration that depend on the kinds in it, for code that does not otherwise care for kinds."""

from __future__ import annotations

from typing_extensions import assert_never

from dyngs.config import (
    AutoColour,
    Config,
    DefaultStrategy,
    DeformField,
    DynamicModel,
    FixedStrategy,
    HumanModel,
    HumanPredictorModel,
    McmcStrategy,
    NetworkColour,
    ShColour,
    StaticModel,
)

MEASURED_AT = 0.6
"""Fraction of a run after which it is measured whose harmonics pay."""


def network_of(config: Config) -> HumanPredictorModel | None:
    """Return the section of a network that predicts scenes; None where a scene is trained."""
    match config.model:
        case HumanPredictorModel():
            return config.model
        case StaticModel() | DynamicModel() | HumanModel():
            return None
        case _:
            assert_never(config.model)


def person_of(config: Config) -> HumanModel | None:
    """Return the section of one person; None for other kinds of model."""
    match config.model:
        case HumanModel():
            return config.model
        case StaticModel() | DynamicModel() | HumanPredictorModel():
            return None
        case _:
            assert_never(config.model)


def field_of(config: Config) -> DeformField | None:
    """Return the section of the deformation field; None for kinds of model without one."""
    match config.model:
        case DynamicModel():
            return config.model.deform
        case StaticModel() | HumanModel() | HumanPredictorModel():
            return None
        case _:
            assert_never(config.model)


def added_for_motion(config: Config) -> int:
    """Return the number of random Gaussians added where motion begins; 0 for kinds of model without any."""
    match config.model:
        case DynamicModel():
            return config.model.num_random_moving
        case StaticModel() | HumanModel() | HumanPredictorModel():
            return 0
        case _:
            assert_never(config.model)


def freezes_below_px(config: Config) -> float | None:
    """Return the motion in pixels below which Gaussians are frozen; None for models without motion over time."""
    match config.model:
        case DynamicModel():
            return config.model.freeze_below_px
        case StaticModel() | HumanModel() | HumanPredictorModel():
            return None
        case _:
            assert_never(config.model)


def stored_sh_degree(config: Config) -> int:
    """Return the degree of the harmonics that training begins with: 0 where a network gives the colours."""
    match config.colour:
        case NetworkColour():
            return 0
        case ShColour() | AutoColour():
            return config.model.sh_degree
        case _:
            assert_never(config.colour)


def harmonics_measured_after(config: Config) -> int | None:
    """Return the step after which it is measured whose harmonics pay; None where it never is."""
    match config.colour:
        case AutoColour():
            return max(1, round(MEASURED_AT * config.train.steps))
        case ShColour() | NetworkColour():
            return None
        case _:
            assert_never(config.colour)


def uses_absgrad(config: Config) -> bool:
    """Return whether the strategy wants the absolute gradients of the 2D means."""
    match config.strategy:
        case DefaultStrategy():
            return config.strategy.absgrad
        case McmcStrategy() | FixedStrategy():
            return False
        case _:
            assert_never(config.strategy)
