"""Tables in the terminal."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from dyngs.core.errors import escaped

if TYPE_CHECKING:
    from rich.table import Table

_WIDTH = 100
"""Columns of the tables where there is no terminal."""


def print_tables(*tables: Table) -> None:
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else _WIDTH)
    for table in tables:
        console.print(table)


def numbers_table(title: str, head: Sequence[str], cells: Sequence[Sequence[str]]) -> Table:
    """Return a table of numbers whose first column is text."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(head[0], title=title, box=box.SIMPLE_HEAD)
    for name in head[1:]:
        table.add_column(name, justify="right")
    for row in cells:
        table.add_row(*(escape(escaped(cell)) for cell in row))
    return table
