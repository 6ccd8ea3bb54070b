"""The plot of a sweep: PSNR against speed and against size."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from dyngs.tradeoff.pareto import pareto_mask
from dyngs.tradeoff.requirements import Figures
from dyngs.tradeoff.variants import SEVERAL
from dyngs.tradeoff.vector_graphics import Circle, Drawing, Line, Shape, Text

PANEL = (520, 400)
"""Width and height, px."""
LEFT, TOP, BOTTOM, RIGHT = 58, 34, 48, 16
LEGEND_ROW = 18
PER_ROW = 6
COLOURS = (
    "#222222",
    "#4477aa",
    "#ee6677",
    "#228833",
    "#ccbb44",
    "#66ccee",
    "#aa3377",
    "#ff8800",
    "#997755",
    "#7755dd",
    "#009988",
    "#ee3399",
    "#88aa22",
    "#cc3311",
    "#0077bb",
    "#555555",
)
"""The run itself first."""
HEADROOM = 0.06


@dataclass(frozen=True)
class _Axis:
    """Values to pixels, linear or logarithmic."""

    low: float
    high: float
    start: float
    end: float
    logarithmic: bool

    def at(self, value: float) -> float:
        a, b, x = (math.log(v) if self.logarithmic else v for v in (self.low, self.high, value))
        return self.start + (self.end - self.start) * (x - a) / (b - a)

    def ticks(self) -> list[float]:
        """Round values inside: 1, 2, 5 times powers of ten; with few of them on a logarithmic axis, evenly spaced."""
        if self.logarithmic:
            powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
            found = [m * 10.0**p for p in powers for m in (1, 2, 5) if self.low <= m * 10.0**p <= self.high]
            if len(found) >= 3:
                return found
        step = _round_step((self.high - self.low) / 5)
        first = math.ceil(self.low / step)
        return [k * step for k in range(first, math.floor(self.high / step) + 1)]


def plot(points: Sequence[Figures]) -> Drawing:
    """Two panels side by side and a legend: a thin line joins the values of a knob, in order, with the run itself; the
    thick grey one what nothing beats in both axes. Values that are not above 0 are left out of logarithmic axes.

    Args:
        points: the run itself first.
    """
    knobs = list(dict.fromkeys(p.variant.knob for p in points if p.variant.knob != SEVERAL))
    colours = {knob: COLOURS[i % len(COLOURS)] for i, knob in enumerate(knobs)} | {SEVERAL: "#888888"}
    if any(p.variant.knob == SEVERAL for p in points):
        knobs.append(SEVERAL)
    rows = math.ceil(len(knobs) / PER_ROW)
    width, height = 2 * PANEL[0], PANEL[1] + rows * LEGEND_ROW + 8
    shapes = [
        *_panel(points, colours, 0, ("speed", "frames per second (more is better)", lambda p: p.fps), 1),
        *_panel(points, colours, PANEL[0], ("size", "MB on disk (less is better)", lambda p: p.mb), -1),
    ]
    for i, knob in enumerate(knobs):
        x, y = LEFT + (i % PER_ROW) * (width - LEFT) / PER_ROW, PANEL[1] + 12 + LEGEND_ROW * (i // PER_ROW)
        shapes += [Circle(x, y - 4, 5, colours[knob]), Text(x + 10, y, knob or "the run itself")]
    return Drawing(width, height, shapes)


def _panel(
    points: Sequence[Figures],
    colours: dict[str, str],
    left: float,
    what: tuple[str, str, Callable[[Figures], float]],
    sign: int,
) -> list[Shape]:
    """One plot; ``sign``: of the goal along x."""
    title, label, value = what
    shown = [p for p in points if value(p) > 0]
    if not shown:
        return []
    low, high = _wider([value(p) for p in shown], logarithmic=True)
    across = _Axis(low, high, left + LEFT, left + PANEL[0] - RIGHT, True)
    up = _Axis(*_wider([p.psnr for p in shown], logarithmic=False), PANEL[1] - BOTTOM, TOP, False)
    places = {p.variant: (across.at(value(p)), up.at(p.psnr)) for p in shown}
    best = pareto_mask([(p.psnr, sign * value(p)) for p in shown])
    front = sorted({places[p.variant] for p, is_best in zip(shown, best, strict=True) if is_best})
    shapes = [*_frame(across, up, f"PSNR and {title}", label), Line(tuple(front), "#d4d4d4", 5)]
    for knob, colour in colours.items():
        if knob not in ("", SEVERAL):
            turned = tuple(places[p.variant] for p in shown if p.variant.knob in ("", knob))
            shapes.append(Line(turned, colour, 0.75))
    for p in reversed(shown):  # the run itself on top
        tip = f"{p.variant.name}: {p.psnr:.2f} dB, {p.fps:.1f} fps, {p.mb:.2f} MB"
        shapes.append(Circle(*places[p.variant], 6.5 if not p.variant.knob else 5, colours[p.variant.knob], tip))
    return shapes


def _frame(across: _Axis, up: _Axis, title: str, label: str) -> list[Shape]:
    """Grid, numbers and words around a panel."""
    shapes: list[Shape] = [Text(across.start, 20, title, size=13, bold=True), Text(across.start - 44, TOP - 8, "dB")]
    for tick in across.ticks():
        x = across.at(tick)
        shapes.append(Line(((x, up.start), (x, up.end)), "#e4e4e4", 1))
        shapes.append(Text(x, up.start + 16, f"{tick:,.6g}", "middle"))
    for tick in up.ticks():
        y = up.at(tick)
        shapes.append(Line(((across.start, y), (across.end, y)), "#e4e4e4", 1))
        shapes.append(Text(across.start - 6, y + 4, f"{tick:,.6g}", "end"))
    middle = (across.start + across.end) / 2
    return [*shapes, Text(middle, up.start + 34, f"{label}, logarithmic", "middle")]


def _wider(values: Sequence[float], *, logarithmic: bool) -> tuple[float, float]:
    """Limits around the values with some room, never empty."""
    low, high = min(values), max(values)
    if logarithmic:
        room = max((high / low) ** HEADROOM, 1.05)
        return low / room, high * room
    room = max(HEADROOM * (high - low), 0.05)
    return low - room, high + room


def _round_step(step: float) -> float:
    """1, 2 or 5 times a power of ten, at least ``step``."""
    power = 10.0 ** math.floor(math.log10(step))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= step * (1 - 1e-9))
