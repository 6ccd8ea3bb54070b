"""The table of a sweep, one row per measured variant, and the best row that meets requirements
(``psnr>=30,mb<=5``)."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields

from dyngs.core.errors import DyngsError, printable
from dyngs.study.tradeoff.measure import Measurement, on_front
from dyngs.study.tradeoff.variants import Variant

METRICS = ("psnr", "ssim", "lpips", "fps", "mb", "memory_mb", "gaussians")
"""Columns that a requirement or a goal may name."""
_CONDITION = re.compile(r"\s*([a-z_]+)\s*(>=|<=)\s*(\S+)\s*$")


@dataclass(frozen=True)
class TableRow:
    """A measured variant, see ``Measurement``. The fields but ``variant``, after its name, are the
    columns of the .csv.

    Attributes:
        fps: frames per second of the run itself times ``gain``, so that variants timed at another
            hour compare.
        gain, gain_low, gain_high: speed relative to the run: median and quartiles of interleaved
            pairs.
        ms: median time of one image as measured.
        on_front: on the Pareto front of PSNR, speed and size.
    """

    variant: Variant
    psnr: float
    ssim: float
    lpips: float | None
    fps: float
    gain: float
    gain_low: float
    gain_high: float
    ms: float
    mb: float
    memory_mb: float | None
    gaussians: int
    on_front: bool

    @property
    def name(self) -> str:
        return self.variant.name

    @property
    def columns(self) -> dict[str, str | float | None]:
        """Names and values of the columns."""
        return {"name": self.name} | {
            f.name: getattr(self, f.name) for f in fields(self) if f.name != "variant"
        }

    def metric(self, name: str) -> float | None:
        """Return the value of one of ``METRICS``; None where it was not measured."""
        return getattr(self, name)


def table_rows(measurements: Sequence[Measurement]) -> list[TableRow]:
    """Return a row per variant whose speed was measured, in their order: the run itself first."""
    base = measurements[0].speed
    fps = 0.0 if base is None else 1e3 / base.ms.median
    return [
        TableRow(
            variant=m.variant,
            psnr=m.psnr,
            ssim=m.ssim,
            lpips=m.lpips,
            fps=fps * m.speed.gain.median,
            gain=m.speed.gain.median,
            gain_low=m.speed.gain.low,
            gain_high=m.speed.gain.high,
            ms=m.speed.ms.median,
            mb=m.mb,
            memory_mb=m.memory_mb,
            gaussians=m.num_gaussians,
            on_front=is_best,
        )
        for m, is_best in zip(measurements, on_front(measurements), strict=True)
        if m.speed is not None
    ]


@dataclass(frozen=True)
class Requirement:
    """``name >= bound``, or ``name <= bound`` if ``at_most``."""

    name: str
    at_most: bool
    bound: float

    def __str__(self) -> str:
        return f"{self.name}{'<=' if self.at_most else '>='}{self.bound:g}"

    def is_met(self, row: TableRow) -> bool:
        """Whether the metric was measured and meets the bound."""
        value = row.metric(self.name)
        return value is not None and (value <= self.bound if self.at_most else value >= self.bound)


@dataclass(frozen=True)
class Goal:
    """The metric to minimise (``smallest``) or maximise."""

    name: str
    smallest: bool

    def cost(self, row: TableRow) -> float:
        """Return a value that is smaller for better rows, infinite where the metric was not
        measured."""
        value = row.metric(self.name)
        return math.inf if value is None else value if self.smallest else -value


def parse_requirements(text: str) -> tuple[Requirement, ...]:
    """Return the conditions of a list such as ``psnr>=30,fps>=20,mb<=5``."""
    return tuple(_requirement(part) for part in text.split(","))


def parse_goal(name: str, *, smallest: bool) -> Goal:
    """Return the goal of ``--minimize`` or ``--maximize``."""
    _require_metric(name, f"--{'minimize' if smallest else 'maximize'} {name}")
    return Goal(name, smallest)


def _require_metric(name: str, option: str) -> None:
    if name not in METRICS:
        raise DyngsError(f"{option}: no such metric; there are {', '.join(METRICS)}")


def choose(rows: Sequence[TableRow], requirements: Sequence[Requirement], goal: Goal) -> TableRow:
    """Return the best row among those that meet all requirements; of equally good ones that with
    the higher PSNR."""
    fitting = [row for row in rows if all(r.is_met(row) for r in requirements)]
    if not fitting:
        raise DyngsError(_explanation(rows, requirements, goal))
    return min(fitting, key=lambda row: (goal.cost(row), -row.psnr, row.variant.slug))


def _requirement(part: str) -> Requirement:
    match = _CONDITION.match(part)
    shown = printable(part.strip(), 60)
    if match is None:
        raise DyngsError(
            f"--require {shown!r} is no condition; write for instance psnr>=30,fps>=20,mb<=5"
        )
    name, sign, number = match.groups()
    _require_metric(name, f"--require {shown}")
    try:
        bound = float(number)
    except ValueError:
        bound = math.nan
    if not math.isfinite(bound):
        raise DyngsError(f"--require {shown}: {printable(number, 30)!r} is not a number")
    return Requirement(name, sign == "<=", bound)


def _explanation(rows: Sequence[TableRow], requirements: Sequence[Requirement], goal: Goal) -> str:
    """Return one line: the best value per requirement with the others met, or, if there is none, on
    its own."""
    relaxed = []
    for binding in requirements:
        others = [r for r in requirements if r is not binding]
        fitting = [
            row
            for row in rows
            if all(r.is_met(row) for r in others) and row.metric(binding.name) is not None
        ]
        if fitting:
            own = Goal(binding.name, binding.at_most)
            nearest = min(fitting, key=lambda row: (own.cost(row), goal.cost(row)))
            best = f"with the others met the best is {nearest.metric(binding.name):.5g} ({nearest.name})"
            relaxed.append(f"{binding} is too strict: {best}")
    if not relaxed:
        relaxed = [f"{r} alone: {_best_value(rows, r)}" for r in requirements]
    return f"no measured variant has {', '.join(map(str, requirements))}; {'; '.join(relaxed)}"


def _best_value(rows: Sequence[TableRow], requirement: Requirement) -> str:
    known = [value for row in rows if (value := row.metric(requirement.name)) is not None]
    if not known:
        return "not measured here"
    return f"the best is {min(known) if requirement.at_most else max(known):.5g}"
