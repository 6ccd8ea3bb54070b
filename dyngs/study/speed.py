"""Rendering speed of several scenes, measured in turn, so that other load affects all alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Annotated

import numpy as np
from pydantic import Field

from dyngs.data.loader import Image
from dyngs.evaluate.view_scores import Drawing, seconds_in_turn
from dyngs.study.stored import AS_STORED

_Measured = Annotated[float, Field(gt=1e-9)]
"""Milliseconds, or a gain: a smaller number is none that was measured."""


@dataclass(frozen=True)
class Quartiles:
    """Median, lower and upper quartile."""

    __pydantic_config__ = AS_STORED
    median: _Measured
    low: _Measured
    high: _Measured


@dataclass(frozen=True)
class Speed:
    """Rendering speed, with deformation and upscaling.

    Attributes:
        ms: milliseconds per image.
        gain: speed relative to the first drawing, over pairs of renders taken right after each
            other.
    """

    __pydantic_config__ = AS_STORED
    ms: Quartiles
    gain: Quartiles


def time_interleaved(
    drawings: Sequence[Drawing], images: Sequence[Image], rounds: int
) -> list[Speed]:
    """Return the speed of each drawing, relative to the first one; arguments as for
    ``seconds_in_turn``."""
    seconds = seconds_in_turn(drawings, images, rounds)
    return [Speed(ms=quartiles(1e3 * own), gain=quartiles(seconds[0] / own)) for own in seconds]


def quartiles(values: np.ndarray) -> Quartiles:
    low, high = np.percentile(values, [25, 75])
    return Quartiles(float(median(values)), float(low), float(high))
