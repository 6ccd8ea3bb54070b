"""The one exception type that users see as a single line."""

from __future__ import annotations


class DyngsError(Exception):
    """Bad input or an impossible request: says what, where and what to do, in one line.

    The command line prints the message and exits with code 2; library callers catch it.
    """
