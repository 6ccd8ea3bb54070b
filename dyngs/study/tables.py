"""Tables of a study as CSV, HTML and Markdown."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from html import escape

STYLE = """\
body { font: 14px sans-serif; max-width: 1060px; margin: 24px auto; }
table { border-collapse: collapse; margin: 16px 0; }
td, th { padding: 2px 10px; text-align: right; border-bottom: 1px solid #ddd; }
td:first-child, th:first-child { text-align: left; }
.marked { background: #eef5ff; }
"""


def csv_text(rows: Sequence[Mapping[str, object]]) -> str:
    """Return rows, at least one, whose keys are the columns."""
    table = io.StringIO()
    writer = csv.DictWriter(table, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return table.getvalue()


def html_table(head: Sequence[str], cells: Sequence[Sequence[str]], marked: Sequence[bool] = ()) -> str:
    """Return a table; ``marked``: which rows stand out."""
    marks = marked or [False] * len(cells)
    lines = [_line("td", row, mark=mark) for row, mark in zip(cells, marks, strict=True)]
    return "\n".join(["<table>", _line("th", head), *lines, "</table>"])


def _line(cell: str, texts: Sequence[str], *, mark: bool = False) -> str:
    cells = "".join(f"<{cell}>{escape(text)}</{cell}>" for text in texts)
    return f"<tr{' class=marked' if mark else ''}>{cells}</tr>"


def markdown_table(head: Sequence[str], cells: Sequence[Sequence[str]]) -> str:
    rows = [head, ["---"] * len(head), *cells]
    return "".join("| " + " | ".join(text.replace("|", "\\|") for text in row) + " |\n" for row in rows)
