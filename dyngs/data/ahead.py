"""Work on the next items of a known order in background threads, so that they are ready when they are asked for."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Ahead(Generic[Item]):
    """Results that are worked on in the background; none of them depends on when that is done.

    Args:
        work: returns the item of an index; it is called in other threads.
        threads: number of these threads; 0: nothing is done ahead.
    """

    def __init__(self, work: Callable[[int], Item], threads: int) -> None:
        self._work, self._threads = work, threads
        self._pool: ThreadPoolExecutor | None = None
        self._pending: dict[int, Future[Item]] = {}
        self._process = os.getpid()

    @property
    def most(self) -> int:
        """Most items that are worked on, or wait to be taken: twice the number of threads."""
        return 2 * self._threads

    def expect(self, indices: Sequence[int]) -> None:
        """Begin to work on the first of ``indices``; what is no longer expected is dropped."""
        if not self._threads:
            return
        if self._process != os.getpid():  # threads do not survive a fork
            self._pool, self._pending, self._process = None, {}, os.getpid()
        wanted = list(dict.fromkeys(indices))[: self.most]
        for index in set(self._pending) - set(wanted):
            dropped = self._pending.pop(index, None)
            if dropped is not None:
                dropped.cancel()
        for index in wanted:
            if index not in self._pending:
                if self._pool is None:
                    self._pool = ThreadPoolExecutor(self._threads, thread_name_prefix="dyngs-images")
                # the context holds which files may be opened, and how large images may be
                self._pending[index] = self._pool.submit(copy_context().run, self._work, index)

    def rest(self) -> None:
        """End the threads, and drop what they have done; they begin anew when something is expected."""
        pool, self._pool, self._pending = self._pool, None, {}
        if pool is not None and self._process == os.getpid():
            pool.shutdown(wait=True, cancel_futures=True)

    def take(self, index: int) -> Item | None:
        """Return the item of ``index``, when it is ready, or None where it was not expected.

        Raises:
            Exception: what the work on it raised.
        """
        found = self._pending.pop(index, None)
        return None if found is None or self._process != os.getpid() else found.result()


def usual_threads() -> int:
    """Return how many threads work ahead: one for every two cores of this process, one to four."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        cores = os.cpu_count() or 1
    return min(max(cores // 2, 1), 4)
