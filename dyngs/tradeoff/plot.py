"""The plot of a sweep as SVG: PSNR against speed and against size, each point with its name."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

from dyngs.tradeoff.front import pareto
from dyngs.tradeoff.requirements import Figures

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
    "#bbbbbb",
)
"""The run itself first, combinations last."""
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


def svg(points: Sequence[Figures]) -> str:
    """A picture of two panels side by side and a legend; the line in each joins what nothing beats in both its axes.

    Hollow points cannot be written as a run. Values that are not above 0 are left out of logarithmic axes.

    Args:
        points: the run itself first.
    """
    knobs = list(dict.fromkeys(p.variant.knob for p in points if p.variant.knob != "several"))
    colours = {knob: COLOURS[min(i, len(COLOURS) - 2)] for i, knob in enumerate(knobs)} | {"several": COLOURS[-1]}
    if any(p.variant.knob == "several" for p in points):
        knobs.append("several")
    rows = math.ceil(len(knobs) / PER_ROW)
    width, height = 2 * PANEL[0], PANEL[1] + rows * LEGEND_ROW + 8
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="sans-serif" font-size="12">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
        *_panel(points, colours, 0, ("speed", "frames per second (more is better)", lambda p: p.fps), 1),
        *_panel(points, colours, PANEL[0], ("size", "MB on disk (less is better)", lambda p: p.mb), -1),
    ]
    for i, knob in enumerate(knobs):
        x, y = LEFT + (i % PER_ROW) * (width - LEFT) / PER_ROW, PANEL[1] + 12 + LEGEND_ROW * (i // PER_ROW)
        parts.append(f'<circle cx="{x:.1f}" cy="{y - 4:.1f}" r="5" fill="{colours[knob]}"/>')
        parts.append(f'<text x="{x + 10:.1f}" y="{y:.1f}">{escape(knob or "the run itself")}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


def _panel(
    points: Sequence[Figures],
    colours: dict[str, str],
    left: float,
    what: tuple[str, str, Callable[[Figures], float]],
    sign: int,
) -> list[str]:
    """One plot; ``sign``: of the goal along x."""
    title, label, value = what
    shown = [p for p in points if value(p) > 0]
    if not shown:
        return []
    low, high = _wider([value(p) for p in shown], logarithmic=True)
    across = _Axis(low, high, left + LEFT, left + PANEL[0] - RIGHT, True)
    up = _Axis(*_wider([p.psnr for p in shown], logarithmic=False), PANEL[1] - BOTTOM, TOP, False)
    parts = [f'<text x="{across.start:.1f}" y="20" font-weight="bold">PSNR and {title}</text>']
    for tick in across.ticks():
        x = across.at(tick)
        parts.append(f'<line x1="{x:.1f}" y1="{up.start}" x2="{x:.1f}" y2="{up.end}" stroke="#dddddd"/>')
        parts.append(f'<text x="{x:.1f}" y="{up.start + 16}" text-anchor="middle">{tick:.3g}</text>')
    for tick in up.ticks():
        y = up.at(tick)
        parts.append(f'<line x1="{across.start}" y1="{y:.1f}" x2="{across.end}" y2="{y:.1f}" stroke="#dddddd"/>')
        parts.append(f'<text x="{across.start - 6}" y="{y + 4:.1f}" text-anchor="end">{tick:.4g}</text>')
    middle = (across.start + across.end) / 2
    parts.append(f'<text x="{middle:.1f}" y="{up.start + 34}" text-anchor="middle">{label}, logarithmic</text>')
    parts.append(f'<text x="{left + 14:.1f}" y="{TOP - 8}" font-size="11">dB</text>')
    best = pareto([(p.psnr, sign * value(p)) for p in shown])
    line = sorted({(value(p), p.psnr) for p, is_best in zip(shown, best, strict=True) if is_best})
    joined = " ".join(f"{across.at(x):.1f},{up.at(y):.1f}" for x, y in line)
    parts.append(f'<polyline points="{joined}" fill="none" stroke="#888888" stroke-width="1.5"/>')
    for point in reversed(shown):  # the run itself on top
        colour, radius = colours[point.variant.knob], 6 if not point.variant.knob else 4.5
        fill = colour if point.variant.fits_a_run else "white"
        parts.append(
            f'<circle cx="{across.at(value(point)):.1f}" cy="{up.at(point.psnr):.1f}" r="{radius}" fill="{fill}" '
            f'stroke="{colour}" stroke-width="2"><title>{escape(_tip(point))}</title></circle>'
        )
    return parts


def _tip(p: Figures) -> str:
    return f"{p.variant.name}: {p.psnr:.2f} dB, {p.fps:.1f} fps, {p.mb:.2f} MB"


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
