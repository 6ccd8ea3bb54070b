"""Imports of what is heavy, inside the commands that need it."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def heavy_imports() -> Iterator[None]:
    """Import torch and what needs it in the block, with the garbage collector at rest.

    Nearly all of the 200,000 objects that this makes live until the exit. Looking through them
    takes a quarter of the time of import and exit, so that they are left out of later collections,
    too. Where torch is imported already, the collector stays as it is: what is there need not be
    for good.
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
