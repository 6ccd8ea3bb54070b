"""The report of a comparison: a table as .csv and .md, curves of quality over seconds, and a page
with crops."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dyngs.study.compare.page import page_text
from dyngs.study.compare.plan import Bench
from dyngs.study.compare.result import Result
from dyngs.study.plots import can_plot, svg_of, write_files
from dyngs.study.tables import csv_text, markdown_table, markdown_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STEM = "comparison"
_LABELS = {"psnr": ("PSNR", ".2f"), "ssim": ("SSIM", ".4f"), "lpips": ("LPIPS", ".4f")}
_LABELS |= {
    "psnr_foreground": ("foregr.", ".2f"),
    "psnr_moving": ("moving", ".2f"),
    "fps": ("fps", ".1f"),
}
_LABELS |= {"mb": ("MB", ".2f"), "gaussians": ("Gaussians", ",.0f"), "steps": ("steps", ",.0f")}
_LABELS |= {"seconds": ("s", ".0f")}


def table_rows(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return a row per model, the best PSNR first."""
    return [_row(result) for result in sorted(results, key=lambda result: -result.psnr)]


def _row(result: Result) -> dict[str, Any]:
    fps = None if result.speed is None else 1e3 / result.speed.ms.median
    return {"model": result.name} | {
        key: fps if key == "fps" else getattr(result, key) for key in _LABELS
    }


def table_cells(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return head and cells of a table, without columns in which no model has a figure."""
    shown = [key for key in _LABELS if any(row[key] is not None for row in rows)]
    head = ["model", *(_LABELS[key][0] for key in shown)]
    cells = [
        [
            row["model"],
            *("-" if row[key] is None else format(row[key], _LABELS[key][1]) for key in shown),
        ]
        for row in rows
    ]
    return head, cells


def about(bench: Bench, results: Sequence[Result]) -> str:
    """Return what all models had the same of, in a line."""
    views = f"{results[0].num_views} held-out views (split {bench.split})"
    return f"{bench.capture.name}: {bench.limit} each, {views}; PSNR in dB, seconds of training"


def write_report(
    bench: Bench, results: Sequence[Result], left_out: Mapping[str, str]
) -> list[Path]:
    """Write the table, the page and, with matplotlib, the plot; return their paths."""
    rows = table_rows(results)
    out = bench.out
    head, cells = table_cells(rows)
    missing = "".join(
        f"\nLeft out: {markdown_text(f'{name}: {problem}')}\n" for name, problem in left_out.items()
    )
    figure = _curves(results) if can_plot() and any(result.curve for result in results) else None
    texts = {
        "csv": csv_text(rows),
        "md": f"{markdown_text(about(bench, results))}\n\n{markdown_table(head, cells)}{missing}",
    }
    svg = "" if figure is None else svg_of(figure)
    texts["html"] = page_text(bench, results, left_out, (about(bench, results), head, cells, svg))
    return write_files(out / STEM, texts, svg, figure)


def _curves(results: Sequence[Result]) -> Figure:
    """Return quality over seconds, logarithmic, a line per model."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure = Figure(figsize=(9, 4.6), layout="constrained")
    axes = figure.subplots()
    for result in results:
        points = [point for point in result.curve if point.seconds > 0]
        axes.plot(
            [p.seconds for p in points], [p.psnr for p in points], "o-", ms=3, label=result.name
        )
    axes.set_xscale("log")
    axes.grid(color="#e4e4e4")
    axes.set_title("PSNR of some held-out views while training", loc="left", fontweight="bold")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.6g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("seconds of training, logarithmic")
    axes.set_ylabel("dB")
    axes.legend(frameon=False)
    return figure
