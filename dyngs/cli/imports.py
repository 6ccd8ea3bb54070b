"""Fast imports of heavy modules inside commands."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def heavy_imports() -> Iterator[None]:
    """Disable the garbage collector while torch is imported in the block, then freeze its objects.

    Scanning these objects, which stay until exit, would take a quarter of the time of import and
    exit. Nothing is changed if torch is already imported.
    """
    if "torch" in sys.modules or not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
