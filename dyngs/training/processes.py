"""The processes that train one scene together, as ``torchrun`` starts them: each takes its fraction
of a step's views.

All hold the same scene and make the same changes to it, from gradients that are summed over them.
Sums are formed in the order of the processes, whatever arrives first: a run repeats byte by byte,
and where each process takes one view, the bytes are those of one process that takes them all.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from types import TracebackType

import torch
from torch import Tensor, distributed
from torch.distributed.distributed_c10d import PrefixStore, Store
from torch.distributed.rendezvous import rendezvous

from dyngs.core.errors import DyngsError

# The others wait while the first one reads, evaluates, or tries settings in small runs
TIMEOUT = timedelta(days=30)
CHUNK = 2**22  # Most values that are summed at once: each process holds those of all for a while
FAILED = "dyngs/failed"  # Key of the store that counts the processes that have said why they end
STOP = "dyngs/stop"  # Key of the store that counts the processes that were told to stop
EXIT_INTERRUPTED = 130  # Exit code of a process that was told to stop, as after Ctrl-C
# Exit code of a process that ends because another one has failed, which has said why
EXIT_FAILED = 2
_NAMES = ("RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE")


class Processes:
    """This process and those that it trains with; a context in which they are connected.

    Whoever fails first says why; the others then end with ``EXIT_FAILED`` and without a word.

    Args:
        rank: number of this process, from 0.
    """

    def __init__(self, rank: int = 0, size: int = 1, local_size: int = 1) -> None:
        self.rank, self.size, self.local_size = rank, size, local_size
        self._store: Store | None = None

    @staticmethod
    def from_torchrun() -> Processes:
        """Return the processes that ``torchrun`` has started, this one alone without it. Raises
        DyngsError."""
        if any(name not in os.environ for name in (*_NAMES, "MASTER_ADDR", "MASTER_PORT")):
            return Processes()
        try:
            return Processes(*(int(os.environ[name]) for name in _NAMES))
        except ValueError:
            raise DyngsError(
                f"{', '.join(_NAMES)} must be numbers, as torchrun sets them"
            ) from None

    @property
    def is_rank_zero(self) -> bool:
        """Whether this is the process that reads what was asked for, writes files, and speaks."""
        return self.rank == 0

    def __enter__(self) -> Processes:
        if self.size == 1:
            return self
        backend = "gloo"
        if torch.cuda.is_available() and distributed.is_nccl_available():
            backend = "cpu:gloo,cuda:nccl"
            torch.cuda.set_device(self.rank % self.local_size % torch.cuda.device_count())
        try:
            store, _, _ = next(iter(rendezvous("env://", timeout=TIMEOUT)))
            self._store = PrefixStore("dyngs", store)
            distributed.init_process_group(
                backend, store=store, rank=self.rank, world_size=self.size, timeout=TIMEOUT
            )
        except (RuntimeError, ValueError) as error:
            raise DyngsError(
                f"the {self.size} processes cannot reach each other: {error}"
            ) from None
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave the others; raise SystemExit instead of an error where another process has told one
        already."""
        if self.size == 1:
            return
        if isinstance(error, Exception) and not self._speaks_first():
            raise SystemExit(EXIT_FAILED) from None
        if error is None:
            distributed.destroy_process_group()

    def views_of_process(self, batch: int) -> range:
        """Return which of the ``batch`` views of a step this process takes."""
        each, rest = divmod(batch, self.size)
        if rest or not each:
            raise DyngsError(
                f"train.batch_size={batch} views cannot be shared evenly among {self.size} processes; give a multiple "
                f"of {self.size}, or start another number of processes"
            )
        return range(self.rank * each, (self.rank + 1) * each)

    def sum_(self, tensors: Sequence[Tensor]) -> None:
        """Replace float32 tensors, of the same shapes in all processes, by their sums over the
        processes."""
        if self.size == 1:
            return
        for x in (x for x in tensors if x.numel()):
            flat = x.reshape(-1)
            for chunk in flat.split(CHUNK):
                chunk.copy_(self._summed(chunk))
            if not x.is_contiguous():  # else they are the same memory
                x.copy_(flat.view_as(x))

    def sum_gradients_(self, leaves: Sequence[Tensor], report: Tensor) -> None:
        """Replace the gradients of ``leaves`` and the values of ``report`` (R,), in place, by their
        sums.

        A leaf without a gradient in all processes keeps none.
        """
        if self.size == 1:
            return
        counts = torch.tensor([float(x.grad is not None) for x in leaves], device=report.device)
        head = torch.cat([report, counts])
        self.sum_([head])
        report.copy_(head[: len(report)])
        for x, count in zip(leaves, head[len(report) :].cpu().tolist(), strict=True):
            if count > 0:
                x.grad = torch.zeros_like(x) if x.grad is None else x.grad.contiguous()
                self.sum_([x.grad])

    def request_stop(self) -> None:
        """Report to rank 0 that this process has received a signal to stop."""
        with suppress(RuntimeError):  # who kept the store has ended
            if self._store is not None:
                self._store.add(STOP, 1)

    def is_stop_requested(self) -> bool:
        """Return whether any process has reported a signal to stop."""
        return self._count(STOP) > 0

    def broadcast_(self, values: Tensor) -> None:
        """Replace the values of a tensor by those of the first process."""
        if self.size > 1:
            with self._connected():
                distributed.broadcast(values, 0)

    def require_same(self, tensors: Mapping[str, Tensor], when: str) -> None:
        """Raise unless the tensors have the same bytes in all processes."""
        if self.size == 1:
            return
        own = torch.tensor([_checksum(tensors)], dtype=torch.int64, device="cpu")
        sums = [torch.zeros_like(own) for _ in range(self.size)]
        with self._connected():
            distributed.all_gather(sums, own)
        others = [rank for rank, x in enumerate(sums) if int(x) != int(sums[0])]
        if others:
            raise DyngsError(
                f"{when}: process {others[0]} has come to other Gaussians than process 0; start all on machines of one "
                "kind, with the same version and the same files, or give all of them one DYNGS_ISA"
            )

    def _summed(self, x: Tensor) -> Tensor:
        """Return the sum (n,) over the processes, in their order."""
        parts = [torch.empty_like(x) for _ in range(self.size)]
        with self._connected():
            distributed.all_gather(parts, x.contiguous())
        total, *others = parts
        for part in others:
            total += part
        return total

    @contextmanager
    def _connected(self) -> Iterator[None]:
        """Turn the error of a broken connection into the end of this process."""
        try:
            yield
        except RuntimeError:
            if self._count(FAILED) > 0:
                raise SystemExit(EXIT_FAILED) from None
            raise DyngsError(
                f"process {self.rank} of {self.size} has lost the others: one has ended without a word (too little "
                "memory?)"
            ) from None

    def _speaks_first(self) -> bool:
        """Return whether no other process has said yet why it ends.

        Without torchrun's agent the first process keeps the store: if it is gone, that process has
        ended before.
        """
        try:
            return self._store is None or self._store.add(FAILED, 1) == 1
        except RuntimeError:
            return False

    def _count(self, key: str) -> int:
        """Return how often the processes have counted up a key of the store."""
        try:
            return 0 if self._store is None else self._store.add(key, 0)
        except RuntimeError:  # who kept the store has ended
            return 0


def _checksum(tensors: Mapping[str, Tensor]) -> int:
    digest = hashlib.sha256()
    for _, x in sorted(tensors.items()):
        digest.update(x.detach().cpu().contiguous().numpy().tobytes())
    return int.from_bytes(digest.digest()[:7], "big")
