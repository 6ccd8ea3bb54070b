"""Plot of a sweep: PSNR against speed and against size; see ``dyngs.study.plots``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from dyngs.study.tradeoff.measure import pareto_mask
from dyngs.study.tradeoff.table import TableRow
from dyngs.study.tradeoff.variants import SEVERAL

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot(rows: Sequence[TableRow]) -> Figure:
    """Return two panels, PSNR against speed and against size, and a legend.

    A thin line joins the run with the values of one setting in their order; the thick grey line is
    the Pareto front of the two axes. Values that are not positive are left out of the logarithmic
    axes. The run itself comes first.
    """
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    found = dict.fromkeys(row.variant.setting for row in rows)
    settings = [
        *(setting for setting in found if setting != SEVERAL),
        *([SEVERAL] if SEVERAL in found else []),
    ]
    shades = colormaps["tab20"].resampled(20)
    colours: dict[str, object] = {setting: shades(i % 20) for i, setting in enumerate(settings)}
    colours |= {"": "#222222", SEVERAL: "#888888"}
    figure = Figure(figsize=(10.4, 4.6), layout="constrained")
    speed, size = figure.subplots(1, 2)
    _draw_panel(speed, rows, colours, lambda row: row.fps, 1)
    _draw_panel(size, rows, colours, lambda row: row.mb, -1)
    for axes, title, label in (
        (speed, "speed", "frames per second (more is better)"),
        (size, "size", "MB on disk (less is better)"),
    ):
        axes.set_title(f"PSNR and {title}", loc="left", fontweight="bold")
        axes.set_xlabel(f"{label}, logarithmic")
        axes.set_ylabel("dB")
    handles = [
        speed.plot([], [], "o", color=colours[setting], label=setting or "the run itself")[0]
        for setting in settings
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False)
    return figure


def _draw_panel(
    axes: Axes,
    rows: Sequence[TableRow],
    colours: dict[str, object],
    value: Callable[[TableRow], float],
    sign: int,
) -> None:
    """Draw PSNR against ``value``; ``sign`` is 1 if more of that is better, -1 otherwise."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    shown = [row for row in rows if value(row) > 0]
    best = pareto_mask([(row.psnr, sign * value(row)) for row in shown])
    front = sorted(
        (value(row), row.psnr) for row, is_best in zip(shown, best, strict=True) if is_best
    )
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.6g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="#e4e4e4")
    axes.margins(0.06)
    axes.plot([x for x, _ in front], [y for _, y in front], color="#d4d4d4", linewidth=5)
    for setting, colour in colours.items():
        joined = [row for row in shown if row.variant.setting in ("", setting)]
        if setting not in ("", SEVERAL):
            axes.plot(
                [value(row) for row in joined],
                [row.psnr for row in joined],
                color=colour,
                linewidth=0.75,
            )
    for row in reversed(shown):  # draws the run itself on top
        tip = f"{row.variant.name}: {row.psnr:.2f} dB, {row.fps:.1f} fps, {row.mb:.2f} MB"
        size = 7 if row.variant.setting else 9
        axes.plot(
            value(row),
            row.psnr,
            "o",
            color=colours[row.variant.setting],
            markeredgecolor="white",
            ms=size,
            gid=tip,
        )
