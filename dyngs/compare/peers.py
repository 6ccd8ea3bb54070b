"""Rows of figures that were not measured here: published ones, or those of other programs."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

from dyngs.errors import DyngsError, printable, reading, require_regular
from dyngs.files.limits import require_at_most

NUMBERS = ("psnr", "ssim", "lpips", "psnr_foreground", "psnr_moving", "fps", "mb", "gaussians", "steps", "seconds")
"""Columns of figures; those of the results have the same names."""
_MOST_BYTES, _MOST_ROWS = 2**20, 200


@dataclass(frozen=True)
class Peer:
    """Figures of a model by somebody else; ``source`` says by whom."""

    name: str
    source: str
    figures: dict[str, float]


def read_peers(path: Path) -> list[Peer]:
    """Return the rows of a CSV file with the columns ``model``, ``source`` and any of ``NUMBERS``.

    Raises:
        DyngsError: no such file, another column, a row without model or source, or what is no number; names the line.
    """
    require_regular(path)
    with reading(path, f"give a CSV file with the columns model, source and any of {', '.join(NUMBERS)}"):
        require_at_most(path, path.stat().st_size, _MOST_BYTES, "bytes")
        with path.open(encoding="utf-8-sig", newline="") as file:
            table = csv.DictReader(file, strict=True)
            columns = [printable(name.strip(), 60) for name in table.fieldnames or ()]
            table.fieldnames = columns
            _require_columns(path, columns)
            peers = [_peer(f"{path}, line {table.line_num}", row) for row in table]
    if not peers:
        raise DyngsError(f"{path}: has no rows; leave out --peers, or add figures")
    require_at_most(path, len(peers), _MOST_ROWS, "rows")
    return peers


def _require_columns(path: Path, columns: list[str]) -> None:
    missing = [name for name in ("model", "source") if name not in columns]
    unknown = [name for name in columns if name not in ("model", "source", *NUMBERS)]
    if missing or unknown or len(set(columns)) < len(columns):
        problem = f"has no column {missing[0]!r}" if missing else "names a column twice"
        problem = f"has an unknown column {unknown[0]!r}" if unknown else problem
        raise DyngsError(f"{path}: {problem}; it needs model and source, and may have {', '.join(NUMBERS)}")


def _peer(where: str, row: dict[str, str]) -> Peer:
    if None in row or None in row.values():
        raise DyngsError(f"{where}: has not as many values as the first line has columns")
    name, source = (printable(row[key].strip(), 80) for key in ("model", "source"))
    if not name or not source:
        raise DyngsError(f"{where}: say which model it is and where the figures are from (model, source)")
    given = {key: text.strip() for key, text in row.items() if key in NUMBERS and text.strip()}
    return Peer(name, source, {key: _number(where, key, text) for key, text in given.items()})


def _number(where: str, key: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DyngsError(f"{where}: {key} is {printable(text, 40)!r}, which is no number; leave it empty where unknown")
    return value
