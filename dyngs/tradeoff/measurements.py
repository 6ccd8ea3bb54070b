"""Measurements of variants, their Pareto front, and their files: one per variant, so that nothing is measured twice."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from pydantic import ConfigDict, Field, TypeAdapter

from dyngs.errors import reading, require_regular
from dyngs.files.write import write_text
from dyngs.tradeoff.variants import Variant

_Measured = Annotated[float, Field(gt=1e-9)]
"""Milliseconds, or a gain: a smaller number is none that was measured."""
_AS_STORED = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True)
class Quartiles:
    """Median, lower and upper quartile."""

    __pydantic_config__ = _AS_STORED
    median: _Measured
    low: _Measured
    high: _Measured


@dataclass(frozen=True)
class Speed:
    """Rendering speed, with deformation and upscaling.

    Attributes:
        ms: milliseconds per image.
        gain: speed relative to the run itself, over pairs of renders taken right after each other.
    """

    ms: Quartiles
    gain: Quartiles


@dataclass(frozen=True)
class Measurement:
    """Quality, size and speed of a variant.

    Attributes:
        psnr, ssim, lpips: means over the views; LPIPS is None where it cannot be computed.
        mb: 1e6 bytes on disk: the .dyngs file, or 4 bytes per value needed for rendering where nothing is quantised.
        memory_mb: largest growth of a process that loads and renders the variant, 1e6 bytes; None where unknown.
        speed: None until it is measured.
    """

    __pydantic_config__ = _AS_STORED
    variant: Variant
    num_views: int
    psnr: float
    ssim: float
    lpips: float | None
    num_gaussians: int
    mb: float
    memory_mb: float | None
    speed: Speed | None = None

    @property
    def gain(self) -> float:
        """Median speed relative to the run itself; 1 until it is measured."""
        return 1.0 if self.speed is None else self.speed.gain.median


_STORED = TypeAdapter(Measurement)


def read_measurement(path: Path) -> Measurement:
    with reading(path, "it is no measurement of a variant: remove it to have it measured again"):
        require_regular(path)
        return _STORED.validate_json(path.read_bytes())


def write_measurement(path: Path, measurement: Measurement) -> None:
    values = asdict(measurement) | {"variant": measurement.variant.changes}
    write_text(path, json.dumps(values, indent=2, allow_nan=False) + "\n")


def pareto_mask(goals: Sequence[Sequence[float]]) -> list[bool]:
    """Return which points are on the Pareto front: no other is as good in all goals and better in one."""
    return [not any(_dominates(other, own) for other in goals) for own in goals]


def on_front(measurements: Sequence[Measurement]) -> list[bool]:
    """Return which variants are on the Pareto front of PSNR, speed and size."""
    return pareto_mask([(m.psnr, m.gain, -m.mb) for m in measurements])


def _dominates(a: Sequence[float], b: Sequence[float]) -> bool:
    return all(x >= y for x, y in zip(a, b, strict=True)) and any(x > y for x, y in zip(a, b, strict=True))
