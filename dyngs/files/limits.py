"""How much a file from others may ask for, checked before it is allocated, and the one variable that allows more."""

from __future__ import annotations

import math
import os
from pathlib import Path

from dyngs.errors import DyngsError

VARIABLE = "DYNGS_LIMITS"
"""Name of the environment variable: 4 allows four times what is allowed without it, of everything."""


def allowed(most: int) -> int:
    """``most`` times what the environment variable ``DYNGS_LIMITS`` says, 1 if it says nothing.

    Raises:
        DyngsError: the variable is not a number of at least 1.
    """
    text = os.environ.get(VARIABLE, "1")
    try:
        factor = float(text)
    except ValueError:
        factor = 0.0
    if not 1 <= factor <= 1e6:
        raise DyngsError(f"{VARIABLE}={text:.20} must be a number from 1 to 1e6: how many times the usual limits hold")
    return int(most * factor)


def require_at_most(where: Path | str, amount: int, most: int, what: str) -> None:
    """Check that a file does not ask for more than is read by default, or than ``DYNGS_LIMITS`` allows.

    Args:
        where: the file.
        amount: how many it asks for.
        most: that are read by default.
        what: they are, in the plural.

    Raises:
        DyngsError: names the file, both numbers, and the variable that allows more.
    """
    if amount > most and amount > allowed(most):
        shown = f"{amount:,}" if amount < 10**18 else "over 10^18"
        factor = math.ceil(amount / most) if amount < 10**18 else "N"
        raise DyngsError(
            f"{where}: asks for {shown} {what}, of which {allowed(most):,} are read at most; if you trust the file, "
            f"set the environment variable {VARIABLE}={factor}"
        )
