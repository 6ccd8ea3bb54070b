"""Report of a study: tables as .csv, .json and .md, a page as .html, and a plot as .svg.

The plot needs matplotlib (extra ``plots``).
"""

from __future__ import annotations

import base64
import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dyngs.core.errors import escape_control_characters, format_one_line
from dyngs.export.html.page import fill_template, script_safe, source_hash
from dyngs.io.write import write_text
from dyngs.study.measure import TRUTH, Measurement
from dyngs.study.tradeoff import SEVERAL, Row, pareto_mask

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MATPLOTLIB_MISSING = "no plot without matplotlib; run pip install 'dyngs[plots]'"
# Headings and formats of the columns
COLUMNS = {
    "psnr": ("PSNR", ".2f"),
    "psnr_worst": ("worst", ".2f"),
    "ssim": ("SSIM", ".4f"),
    "lpips": ("LPIPS", ".4f"),
    "psnr_foreground": ("foregr.", ".2f"),
    "psnr_moving": ("moving", ".2f"),
    "fps": ("fps", ".1f"),
    "gain": ("speed x", ".2f"),
    "mb": ("MB", ".2f"),
    "gaussians": ("Gaussians", ",.0f"),
    "steps": ("steps", ",.0f"),
    "seconds": ("s", ".0f"),
}
_HERE = Path(__file__).parent
Cells = Sequence[Sequence[str]]


@dataclass(frozen=True)
class Table:
    """A table of texts."""

    title: str
    head: Sequence[str]
    cells: Cells


@dataclass(frozen=True)
class Report:
    """Content of a report.

    Attributes:
        values: further values of the .json file.
        left_out: reasons why models were skipped, by name.
        views: name, true image and images of the models, as returned by ``page_views``.
        files: paths of the written report.
    """

    title: str
    about: str
    rows: Sequence[Row]
    table: Table
    values: Mapping[str, Any] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    views: Sequence[Mapping[str, Any]] = ()
    figure: Figure | None = None
    files: Sequence[Path] = ()


def can_plot() -> bool:
    return find_spec("matplotlib") is not None


def build_table(title: str, rows: Sequence[Row]) -> Table:
    """Return a table of rows, without empty columns. Rows on the Pareto front are marked."""
    shown = [key for key in COLUMNS if any(row.get(key) is not None for row in rows)]
    cells = []
    for row in rows:
        texts = ("-" if row[key] is None else format(row[key], COLUMNS[key][1]) for key in shown)
        cells.append([f"* {row['name']}" if row.get("on_front") else row["name"], *texts])
    return Table(title, ["", *(COLUMNS[key][0] for key in shown)], cells)


def page_views(out: Path, results: Sequence[Measurement]) -> list[dict[str, Any]]:
    """Return the views shown on a page, each with the true image and the images of the models."""

    images = out / "images"
    views = []
    for index, (name, _) in enumerate(results[0].views):
        file = f"{index:02d}.png"
        models = [
            {"name": x.name, "psnr": x.views[index][1], "image": _data_url(images / x.name / file)}
            for x in results
        ]
        views.append({"name": name, "truth": _data_url(images / TRUTH / file), "models": models})
    return views


def _data_url(file: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(file.read_bytes()).decode()}"


def write_report(stem: Path, report: Report) -> list[Path]:
    """Write the files of a report with path ``stem`` without suffix. Return their paths."""
    left_out = "".join(
        f"\nSkipped: {markdown_text(f'{name}: {why}')}\n" for name, why in report.left_out.items()
    )
    table = markdown_table(report.table.head, report.table.cells)
    svg = "" if report.figure is None else figure_to_svg(report.figure)
    values = {"rows": list(report.rows), **report.values, "left_out": dict(report.left_out)}
    texts = {
        "csv": csv_text(report.rows),
        "json": json.dumps(values, indent=2, allow_nan=False) + "\n",
        "md": f"{markdown_text(report.about)}\n\n{table}{left_out}",
        "html": page_text(report, svg),
    }
    texts |= {"svg": svg} if svg else {}
    paths = []
    for suffix, text in texts.items():
        paths.append(stem.parent / f"{stem.name}.{suffix}")
        write_text(paths[-1], text)
    return paths


def page_text(report: Report, svg: str) -> str:
    """Return a self-contained page with tables, the plot as SVG (or ""), and synchronised crops."""
    script = _file("page.js") if report.views else ""
    left_out = "".join(
        f"<p>Skipped: <b>{escape(name)}</b>: {escape(why)}</p>"
        for name, why in report.left_out.items()
    )
    table = report.table
    pieces = {
        "title": escape(report.title),
        "about": escape(report.about),
        "style": _file("page.css"),
        "table": html_table(table.head, table.cells),
        "left_out": left_out,
        "plot": svg,
        "crops": _file("crops.html") if report.views else "",
        "views": script_safe(report.views),
        "script": script,
        "script_hash": source_hash(script),
    }
    return fill_template(_file("page.html"), pieces)


def _file(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


# Tables as texts


def csv_text(rows: Sequence[Mapping[str, object]]) -> str:
    """Return rows as CSV. The keys of the first row are the columns.

    Texts that a spreadsheet would interpret as formulas begin with an apostrophe.
    """
    table = io.StringIO()
    writer = csv.DictWriter(table, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: _escape_formula(value) for key, value in row.items()} for row in rows)
    return table.getvalue()


def _escape_formula(value: object) -> object:
    if not isinstance(value, str):
        return value
    return escape_control_characters(
        f"'{value}" if value.lstrip()[:1] in ("=", "+", "-", "@") else value
    )


def html_table(head: Sequence[str], cells: Cells) -> str:
    rows = [
        "".join(f"<{cell}>{escape(text)}</{cell}>" for text in row)
        for cell, row in (("th", head), *(("td", row) for row in cells))
    ]
    return "\n".join(["<table>", *(f"<tr>{row}</tr>" for row in rows), "</table>"])


def markdown_table(head: Sequence[str], cells: Cells) -> str:
    rows = [head, ["---"] * len(head), *cells]
    return "".join("| " + " | ".join(map(markdown_text, row)) + " |\n" for row in rows)


def markdown_text(text: str) -> str:
    """Return ``text`` as one line of Markdown without HTML, links or table columns."""
    return re.sub(r"([\\`*<>\[\]|&])", r"\\\1", format_one_line(text))


# Plots


def figure_to_svg(figure: Figure) -> str:
    """Return a figure as an SVG element. Equal figures give equal text."""
    import matplotlib

    file = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "dyngs", "svg.fonttype": "none"}):
        figure.savefig(file, format="svg", metadata={"Date": None})
    text = file.getvalue()
    return text[text.index("<svg") :]


def _logarithmic(axes: Axes, label: str, title: str) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.6g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="#e4e4e4")
    axes.set_title(title, loc="left", fontweight="bold")
    axes.set_xlabel(f"{label}, logarithmic")
    axes.set_ylabel("dB")


def plot_curves(curves: Mapping[str, Sequence[tuple[int, float, float]]]) -> Figure:
    """Return a plot of PSNR over seconds of training, with a line per model.

    Args:
        curves: (step, seconds, PSNR) by model.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.6), layout="constrained")
    axes = figure.subplots()
    for name, points in curves.items():
        shown = [point for point in points if point[1] > 0]
        axes.plot([x[1] for x in shown], [x[2] for x in shown], "o-", ms=3, label=name)
    _logarithmic(axes, "seconds of training", "PSNR of some held-out views while training")
    axes.legend(frameon=False)
    return figure


def plot_variants(rows: Sequence[Row], settings: Sequence[str]) -> Figure:
    """Return plots of PSNR over speed and over size.

    A thin line joins the values of one setting with the original run, which comes first. The thick
    grey line is the Pareto front of the two axes.

    Args:
        settings: setting of each row.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.4, 4.6), layout="constrained")
    speed, size = figure.subplots(1, 2)
    for axes, key, sign, title, label in (
        (speed, "fps", 1, "PSNR and speed", "frames per second (more is better)"),
        (size, "mb", -1, "PSNR and size", "MB on disk (less is better)"),
    ):
        _logarithmic(axes, label, title)
        best = pareto_mask([(row["psnr"], sign * row[key]) for row in rows])
        front = sorted((row[key], row["psnr"]) for row, on in zip(rows, best, strict=True) if on)
        axes.plot(*zip(*front, strict=True), color="#d4d4d4", linewidth=5)
        for name in reversed(dict.fromkeys(settings)):  # plots the original run on top
            alone = name in ("", SEVERAL)
            shown = [
                row
                for row, own in zip(rows, settings, strict=True)
                if own == name or (own == "" and not alone)
            ]
            places = [row[key] for row in shown], [row["psnr"] for row in shown]
            axes.plot(*places, "o" if alone else "o-", lw=0.75, label=name or "original run")
    figure.legend(*speed.get_legend_handles_labels(), loc="outside lower center", ncols=6)
    return figure
