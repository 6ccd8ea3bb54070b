"""Texts of others stay text in every table."""

from __future__ import annotations

import base64
import csv
import io
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, needs_browser

from dyngs.core.errors import escape_control_characters
from dyngs.io.write import write_image
from dyngs.study.report import (
    Report,
    Table,
    csv_text,
    figure_to_svg,
    html_table,
    markdown_table,
    page_text,
    plot_variants,
)
from dyngs.study.tradeoff import Row

ODD = ["<script>alert(1)</script>", "a|b", 'say "x", y', "é"]


def test_csv_is_read_as_it_was() -> None:
    rows = [{"name": text, "n": str(i)} for i, text in enumerate(ODD)]
    assert list(csv.DictReader(csv_text(rows).splitlines())) == rows


def test_html_shows_it_and_runs_nothing() -> None:
    seen: list[str] = []
    tags: list[str] = []
    parser = HTMLParser()
    parser.handle_data = seen.append  # type: ignore[method-assign]
    parser.handle_starttag = lambda tag, attrs: tags.append(tag)  # type: ignore[method-assign]
    parser.feed(html_table(["name"], [[text] for text in ODD]))
    assert [text for text in seen if text.strip()] == ["name", *ODD]
    assert set(tags) == {"table", "tr", "th", "td"}


@pytest.mark.parametrize(
    "text", ["=HYPERLINK(1)", "+1+cmd|' /C calc'!A0", "-2+3", "@SUM(1)", "\t=1", "\r=1"]
)
def test_csv_holds_no_formulas(text: str) -> None:
    (row,) = csv.reader(
        io.StringIO(csv_text([{"name": text, "dB": -1.5}]).partition("\n")[2], newline="")
    )
    assert row == [f"'{escape_control_characters(text)}", "-1.5"]


def test_markdown_shows_names_as_they_are() -> None:
    (line,) = markdown_table(
        ["name"], [["[a](javascript:b) <img src=x> **c** `d` \n\x1b e_f"]]
    ).splitlines()[2:]
    assert line == r"| \[a\](javascript:b) \<img src=x\> \*\*c\*\* \`d\` \\x1b e_f |"


def row(name: str, psnr: float, fps: float, mb: float) -> Row:
    return {"name": name, "psnr": psnr, "fps": fps, "mb": mb}


def test_lines_of_a_plot_join_the_run_with_a_setting() -> None:
    """Pruning is faster and smaller; fewer harmonics are neither, but a line leads there, too."""
    pytest.importorskip("matplotlib")
    rows = [
        row("original", 30, 10, 5),
        row("prune=0.5", 29, 20, 2),
        row("prune=0.7", 28, 30, 1),
        row("sh_degree=0", 28, 5, 9),
    ]
    figure = plot_variants(rows, ["", "prune", "prune", "sh_degree"])
    for axes in figure.axes:
        front, *lines = axes.lines
        assert len(front.get_xdata()) == 3
        found = {line.get_label(): len(line.get_xdata()) for line in lines}
        assert found == {"original run": 1, "prune": 3, "sh_degree": 2}
    text = figure_to_svg(figure)
    assert "<image" not in text
    assert 'href="http' not in text


NAME = "</script><img src=x onerror=window.ran=1>"


@needs_browser
def test_names_of_captures_views_and_models_are_shown_and_never_run(tmp_path: Path) -> None:
    pixel = "data:image/png;base64," + base64.b64encode(png_bytes(tmp_path)).decode()
    models = [{"name": NAME, "psnr": 1.0, "image": pixel}]
    views = [{"name": NAME, "truth": pixel, "models": models}]
    table = Table(NAME, ["model"], [[NAME]])
    report = Report(NAME, NAME, [], table, left_out={NAME: NAME}, views=views)
    file = tmp_path / "page.html"
    file.write_text(page_text(report, ""), encoding="utf-8")
    with Browser() as browser:
        page = browser.open(file.as_uri())
        page.wait_for("document.querySelectorAll('canvas').length > 0")
        assert page.evaluate("document.body.textContent").count(NAME) >= 4
        assert page.evaluate("window.ran") is None
        assert page.evaluate("document.querySelectorAll('img[src=x]').length") == 0
        assert page.errors == []


def png_bytes(folder: Path) -> bytes:
    write_image(folder / "pixel.png", np.zeros((8, 8, 3), np.uint8))
    return (folder / "pixel.png").read_bytes()
