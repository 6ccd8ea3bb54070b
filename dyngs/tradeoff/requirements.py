"""What a run must be like, as text, and which measured point is best within that."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from dyngs.errors import DyngsError, printable
from dyngs.tradeoff.variants import Variant

_CONDITION = re.compile(r"\s*([a-z_]+)\s*(>=|<=)\s*(\S+)\s*$")


@dataclass(frozen=True)
class Figures:
    """What can be asked of a point; None where it is not known.

    Attributes:
        variant: what it changes.
        psnr: dB.
        ssim, lpips: of the whole split.
        fps: pictures per second.
        mb: on disk, 1e6 bytes.
        memory_mb: at most, while drawing.
        gaussians: N.
    """

    variant: Variant
    psnr: float
    ssim: float
    lpips: float | None
    fps: float
    mb: float
    memory_mb: float | None
    gaussians: int

    def value(self, name: str) -> float | None:
        """The figure of that name."""
        return getattr(self, name)


NAMES = ("psnr", "ssim", "lpips", "fps", "mb", "memory_mb", "gaussians")
"""Fields of ``Figures`` that are numbers."""


@dataclass(frozen=True)
class Requirement:
    """``name >= bound``, or ``name <= bound`` where ``at_most``."""

    name: str
    at_most: bool
    bound: float

    def __str__(self) -> str:
        return f"{self.name}{'<=' if self.at_most else '>='}{self.bound:g}"

    def holds(self, point: Figures) -> bool:
        """Known and met."""
        value = point.value(self.name)
        return value is not None and (value <= self.bound if self.at_most else value >= self.bound)


@dataclass(frozen=True)
class Goal:
    """What is to be as large or as small as possible."""

    name: str
    smallest: bool

    def key(self, point: Figures) -> float:
        """Smaller is better; infinite where it is not known."""
        value = point.value(self.name)
        return math.inf if value is None else value if self.smallest else -value


def parse_requirements(text: str) -> tuple[Requirement, ...]:
    """The conditions in ``text``, for instance ``psnr>=30,fps>=20,mb<=5``.

    Raises:
        DyngsError: one that is none; it says what is allowed.
    """
    return tuple(_requirement(part) for part in text.split(","))


def parse_goal(name: str, *, smallest: bool) -> Goal:
    """What ``--minimize`` or ``--maximize`` asks for.

    Raises:
        DyngsError: an unknown figure.
    """
    if name not in NAMES:
        option = "--minimize" if smallest else "--maximize"
        raise DyngsError(f"{option} {name}: no such figure; there are {', '.join(NAMES)}")
    return Goal(name, smallest)


def choose(points: Sequence[Figures], requirements: Sequence[Requirement], goal: Goal) -> Figures:
    """The best by ``goal`` of the points that meet everything; of equal ones that with the better PSNR.

    Raises:
        DyngsError: none does; it names the requirement that binds and what could be had.
    """
    fitting = [p for p in points if all(r.holds(p) for r in requirements)]
    if not fitting:
        raise DyngsError(_what_binds(points, requirements, goal))
    return min(fitting, key=lambda p: (goal.key(p), -p.psnr, p.variant.slug))


def _requirement(part: str) -> Requirement:
    match, shown = _CONDITION.match(part), printable(part.strip(), 60)
    if match is None:
        raise DyngsError(f"--require {shown!r} is no condition; write for instance psnr>=30,fps>=20,mb<=5")
    name, sign, number = match.groups()
    if name not in NAMES:
        raise DyngsError(f"--require {shown}: no such figure; there are {', '.join(NAMES)}")
    try:
        bound = float(number)
    except ValueError:
        bound = math.nan
    if not math.isfinite(bound):
        raise DyngsError(f"--require {shown}: {printable(number, 30)!r} is not a number")
    return Requirement(name, sign == "<=", bound)


def _what_binds(points: Sequence[Figures], requirements: Sequence[Requirement], goal: Goal) -> str:
    """One line: without which single requirement there would be a point, or what of each can be had at all."""
    asked = ", ".join(str(r) for r in requirements)
    relaxed = []
    for binding in requirements:
        others = [r for r in requirements if r is not binding]
        fitting = [p for p in points if all(r.holds(p) for r in others) and p.value(binding.name) is not None]
        if fitting:
            nearest = min(fitting, key=lambda p: (_miss(binding, p), goal.key(p)))
            relaxed.append(
                f"{binding} binds: with the others {nearest.value(binding.name):.5g} ({nearest.variant.name})"
            )
    if not relaxed:
        relaxed = [f"{r} alone: {_best_of(points, r)}" for r in requirements]
    return f"no measured point has {asked}; {'; '.join(relaxed)}"


def _miss(requirement: Requirement, point: Figures) -> float:
    """By how much a point fails; smaller is nearer."""
    value = point.value(requirement.name)
    assert value is not None
    return value - requirement.bound if requirement.at_most else requirement.bound - value


def _best_of(points: Sequence[Figures], requirement: Requirement) -> str:
    known = [value for p in points if (value := p.value(requirement.name)) is not None]
    if not known:
        return "not measured here"
    return f"the best is {min(known) if requirement.at_most else max(known):.5g}"
