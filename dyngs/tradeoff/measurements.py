"""What was measured of one variant, and its file: one per point, so that nothing is measured twice."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import TypeAdapter

from dyngs.errors import reading, require_regular
from dyngs.files.write import write_text
from dyngs.tradeoff.variants import Variant


@dataclass(frozen=True)
class Quartiles:
    """A median and its quartiles."""

    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Speed:
    """How fast it is drawn, deformation and enlarging included.

    Attributes:
        ms: of one picture.
        gain: how many times as fast as the run itself is, in pairs of pictures drawn one after the other.
    """

    ms: Quartiles
    gain: Quartiles


@dataclass(frozen=True)
class Measurement:
    """A variant of a run, measured.

    Attributes:
        variant: what it changes.
        num_views: of the split, all of them.
        psnr, ssim, lpips: means over them; LPIPS is None where it cannot be had.
        num_gaussians: N.
        mb: on disk, 1e6 bytes: the stored file, or 4 bytes for each value that drawing needs where nothing is rounded.
        memory_mb: what a process grows by at most while it loads and draws it, 1e6 bytes; None where unknown.
        speed: None as long as it is not measured.
    """

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
        """How many times as fast as the run itself; 1 as long as that is not measured."""
        return 1.0 if self.speed is None else self.speed.gain.median


_POINT = TypeAdapter(Measurement)


def read_measurement(path: Path) -> Measurement:
    """The point in a file.

    Raises:
        DyngsError: it is not one.
    """
    with reading(path, "it is no measured point: remove it to have it measured again"):
        require_regular(path)
        stored = json.loads(path.read_text(encoding="utf-8"), parse_float=_finite, parse_constant=_finite)
        variant, speed = Variant.from_json(stored.pop("variant")), stored.pop("speed")
        if speed is not None:
            speed = Speed(Quartiles(**speed["ms"]), Quartiles(**speed["gain"]))
            if min(*speed.ms.__dict__.values(), *speed.gain.__dict__.values()) <= 0:
                raise ValueError("a time that is not positive")
        return _POINT.validate_python(asdict(Measurement(variant=variant, speed=speed, **stored)))


def write_measurement(path: Path, point: Measurement) -> None:
    """Write it, atomically."""
    values = asdict(point) | {"variant": point.variant.to_json()}
    write_text(path, json.dumps(values, indent=2, allow_nan=False) + "\n")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not finite")
    return value
