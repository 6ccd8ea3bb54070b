"""Checks of the numbers that callers set: an error names the option that is out of its range."""

from __future__ import annotations

import math
from collections.abc import Collection

from dyngs.errors import DyngsError

LARGEST = 3.4e38
"""Options are computed with in float32."""

LARGEST_COUNT = 2**31 - 1


def check_number(name: str, value: object, low: float, high: float = LARGEST) -> None:
    """Raise an error unless ``value`` is a number from ``low`` to ``high``.

    Raises:
        DyngsError: it is something else, or NaN.
    """
    if not isinstance(value, (int, float)) or not low <= value <= high:
        upto = "" if high == math.inf else " and finite" if high == LARGEST else f" and at most {high:g}"
        raise DyngsError(f"{name} must be a number of at least {low:g}{upto}, got {value!r}")


def check_near_and_far(near: object, far: object) -> None:
    """Raise an error unless they are the limits of a range of depths; ``far`` may be infinite.

    Raises:
        DyngsError: a negative number or NaN, or ``far`` not beyond ``near``.
    """
    check_number("near", near, 0)
    check_number("far", far, 0, math.inf)
    if not far > near:  # pyright: ignore[reportOperatorIssue]
        raise DyngsError(f"far must lie beyond near, got near {near!r} and far {far!r}")


def check_count(name: str, value: object, low: int, high: int) -> None:
    """Raise an error unless ``value`` is a whole number from ``low`` to ``high``.

    Raises:
        DyngsError: it is something else.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise DyngsError(f"{name} must be a whole number from {low} to {high}, got {value!r}")


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Raise an error unless ``value`` is one of the ``choices``.

    Raises:
        DyngsError: it is not.
    """
    if not isinstance(value, str) or value not in choices:
        raise DyngsError(f"{name} must be one of {', '.join(choices)}, got {value!r}")
