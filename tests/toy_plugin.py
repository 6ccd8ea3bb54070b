"""The toy package as if it were installed, for the time of a test module."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dyngs.config import kinds

FOLDER = Path(__file__).parent / "toy_package"


@contextmanager
def installed() -> Iterator[None]:
    """Let ``model.kind=toy`` be a kind."""
    sys.path.insert(0, str(FOLDER))
    forget()
    try:
        yield
    finally:
        sys.path.remove(str(FOLDER))
        forget()


def forget() -> None:
    kinds.installed_kind.cache_clear()
    kinds.plugin_kinds.cache_clear()
