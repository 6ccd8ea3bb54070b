"""Texts of others stay text in every table."""

from __future__ import annotations

import csv
import io
from html.parser import HTMLParser

import pytest

from dyngs.core.errors import escaped
from dyngs.study.tables import csv_text, html_table, markdown_table

ODD = ["<script>alert(1)</script>", "a|b", 'say "x", y', "é"]


def test_csv_is_read_as_it_was() -> None:
    rows = [{"name": text, "n": str(i)} for i, text in enumerate(ODD)]
    assert list(csv.DictReader(csv_text(rows).splitlines())) == rows


def test_html_shows_it_and_runs_nothing() -> None:
    seen: list[str] = []
    tags: list[tuple[str, object]] = []
    parser = HTMLParser()
    parser.handle_data = seen.append  # type: ignore[method-assign]
    parser.handle_starttag = lambda tag, attrs: tags.append((tag, attrs))  # type: ignore[method-assign]
    parser.feed(html_table(["name"], [[text] for text in ODD], [True, False, False, False]))
    assert [text for text in seen if text.strip()] == ["name", *ODD]
    assert {tag for tag, _ in tags} == {"table", "tr", "th", "td"}
    assert sum(("class", "marked") in attrs for _, attrs in tags) == 1  # type: ignore[operator]


@pytest.mark.parametrize(
    "text", ["=HYPERLINK(1)", "+1+cmd|' /C calc'!A0", "-2+3", "@SUM(1)", "\t=1", "\r=1"]
)
def test_csv_holds_no_formulas(text: str) -> None:
    (row,) = csv.reader(
        io.StringIO(csv_text([{"name": text, "dB": -1.5}]).partition("\n")[2], newline="")
    )
    assert row == [f"'{escaped(text)}", "-1.5"]


def test_markdown_shows_names_as_they_are() -> None:
    (line,) = markdown_table(
        ["name"], [["[a](javascript:b) <img src=x> **c** `d` \n\x1b e_f"]]
    ).splitlines()[2:]
    assert line == r"| \[a\](javascript:b) \<img src=x\> \*\*c\*\* \`d\` \\x1b e_f |"


def test_markdown_has_as_many_columns_in_every_row() -> None:
    lines = markdown_table(["name", "n"], [[text, "1"] for text in ODD]).splitlines()
    assert {line.replace("\\|", "").count("|") for line in lines} == {3}
