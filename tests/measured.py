"""Time and memory of a call, for tests that a small file cannot exhaust either."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable


def cost_of(call: Callable[[], object]) -> tuple[int, float]:
    """Bytes at the peak beyond what was there before, and processor seconds, of a call that may
    raise nothing.

    Memory of Python and NumPy; tracing makes the call several times slower than it is.
    """
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    start = time.process_time()
    try:
        call()
        return tracemalloc.get_traced_memory()[1] - before, time.process_time() - start
    finally:
        tracemalloc.stop()
