"""Plot of a sweep: PSNR against speed and against size."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from dyngs.tradeoff.pareto import pareto_mask
from dyngs.tradeoff.table import TableRow
from dyngs.tradeoff.variants import SEVERAL
from dyngs.tradeoff.vector_graphics import Circle, Drawing, Line, Shape, Text

PANEL = (520, 400)
"""Width and height of a panel, px."""
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
"""Colour of the run itself first."""
HEADROOM = 0.06


@dataclass(frozen=True)
class _Axis:
    """Map of values to pixels, linear or logarithmic."""

    low: float
    high: float
    start: float
    end: float
    logarithmic: bool

    def at(self, value: float) -> float:
        a, b, x = (math.log(v) if self.logarithmic else v for v in (self.low, self.high, value))
        return self.start + (self.end - self.start) * (x - a) / (b - a)

    def ticks(self) -> list[float]:
        """Return 1, 2, 5 times powers of ten; evenly spaced values if a logarithmic axis has fewer than 3 of those."""
        if self.logarithmic:
            powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
            found = [m * 10.0**p for p in powers for m in (1, 2, 5) if self.low <= m * 10.0**p <= self.high]
            if len(found) >= 3:
                return found
        step = _round_step((self.high - self.low) / 5)
        first = math.ceil(self.low / step)
        return [k * step for k in range(first, math.floor(self.high / step) + 1)]


def plot(rows: Sequence[TableRow]) -> Drawing:
    """Return two panels, PSNR against speed and against size, and a legend.

    A thin line joins the run with the values of one setting in their order; the thick grey line is the Pareto front of
    the two axes. Values that are not positive are left out of logarithmic axes.

    Args:
        rows: the run itself first.
    """
    settings = list(dict.fromkeys(p.variant.setting for p in rows if p.variant.setting != SEVERAL))
    colours = {setting: COLOURS[i % len(COLOURS)] for i, setting in enumerate(settings)} | {SEVERAL: "#888888"}
    if any(p.variant.setting == SEVERAL for p in rows):
        settings.append(SEVERAL)
    legend_rows = math.ceil(len(settings) / PER_ROW)
    width, height = 2 * PANEL[0], PANEL[1] + legend_rows * LEGEND_ROW + 8
    shapes = [
        *_panel(rows, colours, 0, ("speed", "frames per second (more is better)", lambda p: p.fps), 1),
        *_panel(rows, colours, PANEL[0], ("size", "MB on disk (less is better)", lambda p: p.mb), -1),
    ]
    for i, setting in enumerate(settings):
        x, y = LEFT + (i % PER_ROW) * (width - LEFT) / PER_ROW, PANEL[1] + 12 + LEGEND_ROW * (i // PER_ROW)
        shapes += [Circle(x, y - 4, 5, colours[setting]), Text(x + 10, y, setting or "the run itself")]
    return Drawing(width, height, shapes)


def _panel(
    rows: Sequence[TableRow],
    colours: dict[str, str],
    left: float,
    axis: tuple[str, str, Callable[[TableRow], float]],
    sign: int,
) -> list[Shape]:
    """Return one panel; ``sign`` is 1 if larger x is better, -1 otherwise."""
    title, label, value = axis
    shown = [p for p in rows if value(p) > 0]
    if not shown:
        return []
    low, high = _wider([value(p) for p in shown], logarithmic=True)
    across = _Axis(low, high, left + LEFT, left + PANEL[0] - RIGHT, True)
    up = _Axis(*_wider([p.psnr for p in shown], logarithmic=False), PANEL[1] - BOTTOM, TOP, False)
    places = {p.variant: (across.at(value(p)), up.at(p.psnr)) for p in shown}
    best = pareto_mask([(p.psnr, sign * value(p)) for p in shown])
    front = sorted({places[p.variant] for p, is_best in zip(shown, best, strict=True) if is_best})
    shapes = [*_frame(across, up, f"PSNR and {title}", label), Line(tuple(front), "#d4d4d4", 5)]
    for setting, colour in colours.items():
        if setting not in ("", SEVERAL):
            turned = tuple(places[p.variant] for p in shown if p.variant.setting in ("", setting))
            shapes.append(Line(turned, colour, 0.75))
    for p in reversed(shown):  # draws the run itself on top
        tip = f"{p.variant.name}: {p.psnr:.2f} dB, {p.fps:.1f} fps, {p.mb:.2f} MB"
        shapes.append(Circle(*places[p.variant], 6.5 if not p.variant.setting else 5, colours[p.variant.setting], tip))
    return shapes


def _frame(across: _Axis, up: _Axis, title: str, label: str) -> list[Shape]:
    """Return grid, tick labels, title and axis label."""
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
    """Return limits with some margin around the values, never empty."""
    low, high = min(values), max(values)
    if logarithmic:
        room = max((high / low) ** HEADROOM, 1.05)
        return low / room, high * room
    room = max(HEADROOM * (high - low), 0.05)
    return low - room, high + room


def _round_step(step: float) -> float:
    """Return 1, 2, 5 or 10 times a power of ten that is at least ``step``."""
    power = 10.0 ** math.floor(math.log10(step))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= step * (1 - 1e-9))
