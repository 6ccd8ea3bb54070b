"""The report of a sweep: tables as .csv, .json and .html, and a plot."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from dyngs.study.plots import can_plot, svg_of, write_files
from dyngs.study.tables import STYLE, csv_text, html_table
from dyngs.study.tradeoff.measure import Measurement
from dyngs.study.tradeoff.pareto import ExchangeRate, exchange_rates
from dyngs.study.tradeoff.plot import plot
from dyngs.study.tradeoff.table import TableRow, table_rows

STEM = "tradeoff"
_UNDER_PLOT = (
    "<p>Thick lines: Pareto fronts of the two axes. Thin lines: the values of one setting in their order. "
    "Hover over a point for its name.</p>"
)
_HEAD = (
    "changed",
    "PSNR dB",
    "SSIM",
    "LPIPS",
    "fps",
    "times as fast (quartiles)",
    "MB",
    "memory MB",
    "number",
)
_COSTS = ("dB lost per doubled speed", "dB lost per halved size")
EXCHANGE_HEAD = ("setting", *_COSTS, "most speed, times", "most size, times")


def write_report(out: Path, measurements: Sequence[Measurement]) -> list[Path]:
    """Write ``tradeoff.csv``, ``.json`` and ``.html``, with matplotlib ``.svg`` and ``.png``, too;
    return their paths.

    The page needs no other files and no network. ``measurements`` have speeds, the run itself comes
    first.
    """
    rows = table_rows(measurements)
    rates = exchange_rates(measurements[0], measurements)
    figure = plot(rows) if can_plot() else None
    svg = "" if figure is None else svg_of(figure)
    values = {
        "points": [row.columns | {"changes": row.variant.changes} for row in rows],
        "exchange_rates": [asdict(rate) for rate in rates],
        "num_views": measurements[0].num_views,
    }
    texts = {
        "csv": csv_text([row.columns for row in rows]),
        "json": json.dumps(values, indent=2, allow_nan=False) + "\n",
        "html": _page(rows, rates, svg),
    }
    return write_files(out / STEM, texts, svg, figure)


def exchange_cells(rate: ExchangeRate) -> tuple[str, ...]:
    costs = (
        "no gain" if cost is None else f"{cost:+.2f}"
        for cost in (rate.db_per_speed, rate.db_per_size)
    )
    return rate.setting, *costs, f"{rate.speed:.2f}", f"{rate.size:.2f}"


def _cells(row: TableRow) -> tuple[str, ...]:
    return (
        row.name,
        f"{row.psnr:.2f}",
        f"{row.ssim:.4f}",
        "-" if row.lpips is None else f"{row.lpips:.4f}",
        f"{row.fps:.1f}",
        f"{row.gain:.2f} ({row.gain_low:.2f} to {row.gain_high:.2f})",
        f"{row.mb:.2f}",
        "-" if row.memory_mb is None else f"{row.memory_mb:.0f}",
        f"{row.gaussians:,}",
    )


def _page(rows: Sequence[TableRow], rates: Sequence[ExchangeRate], svg: str) -> str:
    front = [row.on_front for row in rows]
    return "\n".join(
        [
            '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Tradeoff</title>',
            f"<style>{STYLE}</style></head><body><h1>Quality, speed and size</h1>",
            f"{svg}{_UNDER_PLOT if svg else ''}",
            "<h2>Each setting alone</h2>",
            html_table(EXCHANGE_HEAD, [exchange_cells(rate) for rate in rates]),
            "<h2>All variants</h2><p>Shaded: Pareto front of PSNR, speed and size.</p>",
            html_table(_HEAD, [_cells(row) for row in rows], front),
            "</body></html>",
        ]
    )
