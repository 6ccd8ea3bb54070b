"""Tables of a study as CSV, HTML and Markdown."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from html import escape

from dyngs.core.errors import escaped, printable

STYLE = """\
body { font: 14px sans-serif; max-width: 1060px; margin: 24px auto; }
table { border-collapse: collapse; margin: 16px 0; }
td, th { padding: 2px 10px; text-align: right; border-bottom: 1px solid #ddd; }
td:first-child, th:first-child { text-align: left; }
.marked { background: #eef5ff; }
"""


def csv_text(rows: Sequence[Mapping[str, object]]) -> str:
    """Return rows, at least one, whose keys are the columns.

    Texts that a spreadsheet would take for formulas begin with an apostrophe.
    """
    table = io.StringIO()
    writer = csv.DictWriter(table, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: _no_formula(value) for key, value in row.items()} for row in rows)
    return table.getvalue()


def _no_formula(value: object) -> object:
    if not isinstance(value, str):
        return value
    return escaped(f"'{value}" if value.lstrip()[:1] in ("=", "+", "-", "@") else value)


def html_table(
    head: Sequence[str], cells: Sequence[Sequence[str]], marked: Sequence[bool] = ()
) -> str:
    """Return a table; ``marked``: which rows stand out."""
    marks = marked or [False] * len(cells)
    lines = [_line("td", row, mark=mark) for row, mark in zip(cells, marks, strict=True)]
    return "\n".join(["<table>", _line("th", head), *lines, "</table>"])


def _line(cell: str, texts: Sequence[str], *, mark: bool = False) -> str:
    cells = "".join(f"<{cell}>{escape(text)}</{cell}>" for text in texts)
    return f"<tr{' class=marked' if mark else ''}>{cells}</tr>"


def markdown_table(head: Sequence[str], cells: Sequence[Sequence[str]]) -> str:
    rows = [head, ["---"] * len(head), *cells]
    return "".join("| " + " | ".join(map(markdown_text, row)) + " |\n" for row in rows)


def markdown_text(text: str) -> str:
    """Return ``text`` as one line of Markdown in which names are no HTML, links or columns."""
    return re.sub(r"([\\`*<>\[\]|&])", r"\\\1", printable(text))
