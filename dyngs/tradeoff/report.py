"""The files of a sweep: a table for programs, the same for people, and a plot."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path

from dyngs.files.write import write_image, write_text
from dyngs.tradeoff.measurements import Measurement
from dyngs.tradeoff.pareto import ExchangeRate, exchange_rates, on_front
from dyngs.tradeoff.plot import plot
from dyngs.tradeoff.sweep import figures_of

STEM = "tradeoff"
_STYLE = """\
body { font: 14px sans-serif; max-width: 1060px; margin: 24px auto; }
table { border-collapse: collapse; margin: 16px 0; }
td, th { padding: 2px 10px; text-align: right; border-bottom: 1px solid #ddd; }
td:first-child, th:first-child { text-align: left; }
.front { background: #eef5ff; }
"""


@dataclass(frozen=True)
class Row:
    """A point in the table; the fields are the columns of the .csv.

    Attributes:
        name: what is changed.
        psnr, ssim, lpips: means over the split.
        fps: of the run itself, times ``gain``.
        gain, gain_low, gain_high: how many times as fast as the run: median and quartiles of pairs drawn in turn.
        ms: median of one picture, as it was measured.
        mb, memory_mb, gaussians: see ``Measurement``.
        on_front: no other point is as good in PSNR, speed and size.
    """

    name: str
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


def rows_of(points: Sequence[Measurement]) -> list[Row]:
    """One per point that was timed, in their order."""
    rows = []
    for point, figures, front in zip(points, figures_of(points), on_front(points), strict=True):
        if point.speed is not None:
            gain = point.speed.gain
            rows.append(
                Row(
                    name=point.variant.name,
                    psnr=point.psnr,
                    ssim=point.ssim,
                    lpips=point.lpips,
                    fps=figures.fps,
                    gain=gain.median,
                    gain_low=gain.low,
                    gain_high=gain.high,
                    ms=point.speed.ms.median,
                    mb=point.mb,
                    memory_mb=point.memory_mb,
                    gaussians=point.num_gaussians,
                    on_front=front,
                )
            )
    return rows


def write_report(out: Path, points: Sequence[Measurement]) -> list[Path]:
    """``tradeoff.csv``, ``.json``, ``.svg``, ``.html`` and ``.png`` in ``out``.

    The page needs nothing beside it, and no network.

    Args:
        out: folder.
        points: timed, the run itself first.
    """
    rows, found = rows_of(points), exchange_rates(points[0], points)
    drawing = plot(figures_of(points))
    table = io.StringIO()
    writer = csv.DictWriter(table, list(asdict(rows[0])), lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    values = {
        "points": [asdict(row) | {"changes": p.variant.to_json()} for row, p in zip(rows, points, strict=True)],
        "exchange_rates": [asdict(exchange) for exchange in found],
        "num_views": points[0].num_views,
    }
    texts = {
        "csv": table.getvalue(),
        "json": json.dumps(values, indent=2, allow_nan=False) + "\n",
        "svg": drawing.svg(),
        "html": _page(rows, found, drawing.svg()),
    }
    for suffix, text in texts.items():
        write_text(out / f"{STEM}.{suffix}", text)
    write_image(out / f"{STEM}.png", drawing.pixels())
    return [out / f"{STEM}.{suffix}" for suffix in (*texts, "png")]


def _table_cells(row: Row) -> tuple[str, ...]:
    """What people read of a row, below ``_TABLE_HEAD``."""
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


_TABLE_HEAD = (
    "changed",
    "PSNR dB",
    "SSIM",
    "LPIPS",
    "fps",
    "times as fast (quartiles)",
    "MB",
    "memory MB",
    "Gaussians",
)


def exchange_cells(exchange: ExchangeRate) -> tuple[str, ...]:
    """What people read of an exchange rate, below ``EXCHANGE_HEAD``."""
    prices = (exchange.db_per_speed, exchange.db_per_size)
    return (
        exchange.knob,
        *("no gain" if price is None else f"{price:+.2f}" for price in prices),
        f"{exchange.speed:.2f}",
        f"{exchange.size:.2f}",
    )


EXCHANGE_HEAD = (
    "knob",
    "dB lost per doubled speed",
    "dB lost per halved size",
    "most speed, times",
    "most size, times",
)


def _page(rows: Sequence[Row], found: Sequence[ExchangeRate], picture: str) -> str:
    body = [_line("th", _TABLE_HEAD), *(_line("td", _table_cells(row), front=row.on_front) for row in rows)]
    prices = [_line("th", EXCHANGE_HEAD), *(_line("td", exchange_cells(exchange)) for exchange in found)]
    return "\n".join(
        [
            '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Tradeoff</title>',
            f"<style>{_STYLE}</style></head><body><h1>What each knob costs and brings</h1>",
            picture,
            "<p>The thick lines join what nothing beats in both axes, thin ones the values of a knob in their order. "
            "Rest the pointer on a point for its name.</p>",
            "<h2>Knobs, each alone</h2><table>",
            *prices,
            "</table><h2>Points</h2><p>Shaded: beaten by no other in PSNR, speed and size together.</p><table>",
            *body,
            "</table></body></html>",
        ]
    )


def _line(cell: str, texts: Sequence[str], *, front: bool = False) -> str:
    cells = "".join(f"<{cell}>{escape(text)}</{cell}>" for text in texts)
    return f"<tr{' class=front' if front else ''}>{cells}</tr>"
