"""Limits on what untrusted files may ask for; JSON files; checks of values from files: required
keys, numbers, matrices."""

from __future__ import annotations

import json
import math
from collections.abc import Collection
from pathlib import Path
from typing import Any, TextIO, TypeGuard

import numpy as np

from dyngs.core.errors import DyngsError, require_regular_file, wrap_read_errors
from dyngs.io.containment import check_inside, require_at_most

MOST_TEXT_BYTES = 1 << 26
"""Largest JSON or text file: 64 MiB hold the cameras of 100,000 images."""


def read_limited(path: Path, most: int = MOST_TEXT_BYTES) -> bytes:
    """Return the bytes of a file, at most ``most``, a limit that ``DYNGS_LIMITS`` may raise.

    Raises:
        DyngsError: it is larger, a pipe or a device.
        OSError: it cannot be read.
    """
    require_regular_file(path)
    require_at_most(path, path.stat().st_size, most, "bytes")
    return path.read_bytes()


LARGEST = 1e30
"""Magnitude up to which numbers are taken: in float32 they, and sums of a few, are finite."""


def read_json_object(path: Path, what: str = "it must be a JSON object") -> dict[str, Any]:
    """Read the JSON object in ``path``. ``what``: the error for anything else."""
    fields = read_json(path)
    if not isinstance(fields, dict):
        raise DyngsError(f"{path}: {what}")
    return fields


def read_json(path: Path) -> Any:
    """Read the JSON in ``path``, UTF-8, 16 or 32. Raises DyngsError."""
    with wrap_read_errors(path, "it must be a JSON file; copy or export it again"):
        try:
            return json.loads(read_limited(check_inside(path)))
        except json.JSONDecodeError as error:
            where = f"{path}, line {error.lineno} column {error.colno}"
            raise DyngsError(
                f"{where}: invalid JSON ({error.msg}); copy or export it again"
            ) from error


def read_text(path: Path) -> str:
    """Return the text of a file within the limit on its size, UTF-8 or, as its first bytes show,
    UTF-16 or UTF-32."""
    data = read_limited(check_inside(path))
    return data.decode(json.detect_encoding(data))


def open_text(path: Path) -> TextIO:
    """Open a text file for reading, UTF-8 or, as its first bytes show, UTF-16 or UTF-32."""
    with check_inside(path).open("rb") as file:
        start = file.read(4)
    return path.open(encoding=json.detect_encoding(start))


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a value from a JSON file is a number; true and false are not."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def parse_matrix(where: str, key: str, value: object) -> np.ndarray:
    """Return the numbers of a 4x4 matrix in a JSON file as float64; shape and values are not
    checked."""
    array = as_float_array(value)
    if array is None:
        raise DyngsError(f"{where}: {key} must hold 4x4 numbers; export it again")
    return array


def require_key(where: object, fields: object, key: str) -> Any:
    """Return ``fields[key]`` of a dictionary from a file."""
    if not isinstance(fields, dict):
        raise DyngsError(f"{where}: must be a dictionary with the key '{key}'; export it again")
    if key not in fields:
        raise DyngsError(f"{where}: the key '{key}' is missing; export it again")
    return fields[key]


def parse_numbers(where: object, value: object, shape: tuple[int, ...] | None) -> np.ndarray:
    """Return float64 numbers up to ``LARGEST``, reshaped to ``shape``, or flat if that is None; the
    file may differ."""
    array = as_float_array(value)
    fits = array is not None and (shape is None or array.size == math.prod(shape))
    if array is None or not fits or not (np.abs(array) <= LARGEST).all():
        count = "x".join(map(str, shape)) + " " if shape else ""
        raise DyngsError(f"{where} must hold {count}finite numbers; export it again")
    return array.ravel() if shape is None else array.reshape(shape)


def first_few(items: Collection[object]) -> str:
    """Return the first five items as text for messages, and how many more there are."""
    return ", ".join(str(item) for item in list(items)[:5]) + (
        f" and {len(items) - 5} more" if len(items) > 5 else ""
    )


def as_float_array(value: object) -> np.ndarray | None:
    """Return ``value`` as a float64 array, None where it holds anything but numbers."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
