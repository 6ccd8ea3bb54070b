"""Limits on the memory that untrusted files may ask for, and the environment variable that raises
them."""

from __future__ import annotations

import math
import os
from pathlib import Path

from dyngs.core.errors import DyngsError, require_regular

VARIABLE = "DYNGS_LIMITS"
"""Environment variable that multiplies all limits: 4 allows four times as much of everything."""
MOST_TEXT_BYTES = 1 << 26
"""Largest JSON or text file: 64 MiB hold the cameras of 100,000 images."""


def allowed(most: int) -> int:
    """Return ``most`` times the value of the environment variable ``DYNGS_LIMITS``, 1 if it is not
    set."""
    text = os.environ.get(VARIABLE, "1")
    try:
        factor = float(text)
    except ValueError:
        factor = 0.0
    if not 1 <= factor <= 1e6:
        raise DyngsError(
            f"{VARIABLE}={text:.20} must be a number from 1 to 1e6: how many times the usual limits hold"
        )
    return int(most * factor)


def require_at_most(where: Path | str, amount: int, most: int, what: str) -> None:
    """Check that a file asks for at most ``most`` of ``what`` (plural), a limit that
    ``DYNGS_LIMITS`` may raise."""
    if amount > most and amount > allowed(most):
        shown = f"{amount:,}" if amount < 10**18 else "over 10^18"
        factor = math.ceil(amount / most) if amount < 10**18 else "N"
        raise DyngsError(
            f"{where}: asks for {shown} {what}, of which {allowed(most):,} are read at most; if you trust the file, "
            f"set the environment variable {VARIABLE}={factor}"
        )


def read_limited(path: Path, most: int = MOST_TEXT_BYTES) -> bytes:
    """Return the bytes of a file, at most ``most``, a limit that ``DYNGS_LIMITS`` may raise.

    Raises:
        DyngsError: it is larger, a pipe or a device.
        OSError: it cannot be read.
    """
    require_regular(path)
    require_at_most(path, path.stat().st_size, most, "bytes")
    return path.read_bytes()
