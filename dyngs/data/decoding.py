"""Images of views as they are kept in memory, and work on the next ones in background threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import torch
from torch import Tensor

from dyngs.ops.device import Upload


@dataclass(frozen=True)
class Decoded:
    """Pixels (H, W, 3 or 4) uint8, straight alpha, mask (H, W) bool, and maps as those of
    ``Image``."""

    pixels: Tensor
    mask: Tensor | None
    moves: Tensor | None = None
    labels: Tensor | None = None
    depth: Tensor | None = None
    flow: Tensor | None = None

    @property
    def num_bytes(self) -> int:
        return sum(x.nbytes for x in self._there().values())

    def upload(self, device: torch.device) -> Callable[[], Decoded]:
        """Begin to copy everything to ``device``; the result returns the image there."""
        arrays = self._there()
        upload = Upload(list(arrays.values()), device)
        return lambda: replace(self, **dict(zip(arrays, upload.arrays(), strict=True)))

    def _there(self) -> dict[str, Tensor]:
        return {name: x for name, x in vars(self).items() if x is not None}


Item = TypeVar("Item")


class Ahead(Generic[Item]):
    """Results that ``threads`` work on in the background, 0: none; none of them depends on when
    that is done."""

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
        expected = list(dict.fromkeys(indices))[: self.most]
        for index in set(self._pending) - set(expected):
            dropped = self._pending.pop(index, None)
            if dropped is not None:
                dropped.cancel()
        for index in expected:
            if index not in self._pending:
                if self._pool is None:
                    self._pool = ThreadPoolExecutor(
                        self._threads, thread_name_prefix="dyngs-images"
                    )
                # the context holds which files may be opened, and how large images may be
                self._pending[index] = self._pool.submit(copy_context().run, self._work, index)

    def rest(self) -> None:
        """End the threads, and drop what they have done; they begin anew when something is
        expected."""
        pool = self._pool
        self._pool = None
        self._pending = {}
        if pool is not None and self._process == os.getpid():
            pool.shutdown(wait=True, cancel_futures=True)

    def take(self, index: int) -> Item | None:
        """Return the item of ``index`` when it is ready, or raise what the work raised; None where
        not expected."""
        found = self._pending.pop(index, None)
        return None if found is None or self._process != os.getpid() else found.result()


def usual_threads() -> int:
    """Return how many threads work ahead: one for every two cores of this process, one to four."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        cores = os.cpu_count() or 1
    return min(max(cores // 2, 1), 4)
