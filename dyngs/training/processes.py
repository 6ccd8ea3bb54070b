"""Data-parallel training of one scene by several processes, as started by ``torchrun``.

Each process renders a part of the views of a step. All processes hold the same scene and apply the
same updates, from gradients that are summed over processes. Sums are computed in the order of
ranks, so runs are reproducible byte by byte. With one view per process, the result equals that of a
single process with the same batch size.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any

import torch
from torch import Tensor, distributed
from torch.distributed.distributed_c10d import PrefixStore, Store
from torch.distributed.rendezvous import rendezvous

from dyngs.core.errors import DyngsError
from dyngs.ops.device import CPU

# Other ranks wait while rank 0 reads data, evaluates or runs pilot runs
TIMEOUT = timedelta(days=30)
CHUNK = 2**22  # Most values summed at once, since each process receives those of all others
FAILED = "dyngs/failed"  # Store key: number of processes that reported an error
STOP = "dyngs/stop"  # Store key: number of processes that received a signal to stop
EXIT_INTERRUPTED = 130  # Exit code of a process that received a signal to stop, as after Ctrl-C
EXIT_FAILED = 2  # Exit code of a process that ends because another one reported an error
_NAMES = ("RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE")


class Processes:
    """The processes that train together; a context manager that connects them.

    The first process that fails raises its error. The others exit with ``EXIT_FAILED`` without a
    message.

    Args:
        rank: number of this process, from 0. Only rank 0 reads the config, writes files and logs.
        size: number of processes.
        local_size: number of processes on this machine.
    """

    def __init__(self, rank: int = 0, size: int = 1, local_size: int = 1) -> None:
        self.rank, self.size, self.local_size = rank, size, local_size
        self._store: Store | None = None

    @staticmethod
    def from_torchrun() -> Processes:
        """Return the processes that ``torchrun`` started, or a single one without it."""
        if any(name not in os.environ for name in (*_NAMES, "MASTER_ADDR", "MASTER_PORT")):
            return Processes()
        return Processes(*(int(os.environ[name]) for name in _NAMES))

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
                f"{self.size} processes could not connect to each other: {error}"
            ) from None
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Disconnect. Raise SystemExit instead of an error if another process has reported one."""
        if self.size == 1:
            return
        if isinstance(error, Exception) and not self._reports_first():
            raise SystemExit(EXIT_FAILED) from None
        if error is None:
            distributed.destroy_process_group()

    def views_of_process(self, batch: int) -> range:
        """Return which of the ``batch`` views of a step this process renders."""
        each, rest = divmod(batch, self.size)
        if rest or not each:
            raise DyngsError(
                f"train.batch_size={batch}: must be a multiple of the number of processes, "
                f"{self.size}"
            )
        return range(self.rank * each, (self.rank + 1) * each)

    def sum_(self, tensors: Sequence[Tensor]) -> None:
        """Replace float32 tensors, of equal shapes in all processes, by their sums over
        processes."""
        if self.size == 1:
            return
        for x in (x for x in tensors if x.numel()):
            flat = x.reshape(-1)
            for chunk in flat.split(CHUNK):
                chunk.copy_(self._summed(chunk))
            if not x.is_contiguous():  # otherwise flat is a view of x
                x.copy_(flat.view_as(x))

    def sum_gradients_(self, leaves: Sequence[Tensor], report: Tensor) -> None:
        """Replace the gradients of ``leaves`` and the values ``report`` (R,) by their sums over
        processes.

        A leaf without a gradient in any process keeps none.
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
        """Report to rank 0 that this process received a signal to stop."""
        with suppress(RuntimeError):  # the host of the store has ended
            if self._store is not None:
                self._store.add(STOP, 1)

    def is_stop_requested(self) -> bool:
        """Return whether any process received a signal to stop."""
        return self._count(STOP) > 0

    def broadcast(self, value: Any) -> Any:
        """Return the picklable ``value`` of rank 0 in all processes."""
        values = [value]
        if self.size > 1:
            with self._connected():
                distributed.broadcast_object_list(values, 0, device=CPU)
        return values[0]

    def require_same(self, tensors: Mapping[str, Tensor], when: str) -> None:
        """Raise DyngsError unless the tensors have the same bytes in all processes."""
        if self.size == 1:
            return
        sums = [""] * self.size
        with self._connected():
            distributed.all_gather_object(sums, _checksum(tensors))
        others = [rank for rank, x in enumerate(sums) if x != sums[0]]
        if others:
            raise DyngsError(
                f"{when}: Gaussians of process {others[0]} differ from those of process 0; "
                "use the same hardware, version and files for all processes, or set DYNGS_ISA"
            )

    def _summed(self, x: Tensor) -> Tensor:
        """Return the sum (n,) over processes, in the order of their ranks."""
        parts = [torch.empty_like(x) for _ in range(self.size)]
        with self._connected():
            distributed.all_gather(parts, x.contiguous())
        total, *others = parts
        for part in others:
            total += part
        return total

    @contextmanager
    def _connected(self) -> Iterator[None]:
        """Exit, or raise DyngsError, if the connection is broken."""
        try:
            yield
        except RuntimeError:
            if self._count(FAILED) > 0:
                raise SystemExit(EXIT_FAILED) from None
            raise DyngsError(
                f"process {self.rank} of {self.size}: connection lost, another process was killed "
                "(out of memory?)"
            ) from None

    def _reports_first(self) -> bool:
        """Return whether no other process has reported an error yet.

        Without torchrun's agent, rank 0 hosts the store. If the store is gone, rank 0 has ended.
        """
        try:
            return self._store is None or self._store.add(FAILED, 1) == 1
        except RuntimeError:
            return False

    def _count(self, key: str) -> int:
        """Return the value of a counter in the store."""
        try:
            return 0 if self._store is None else self._store.add(key, 0)
        except RuntimeError:  # the host of the store has ended
            return 0


def _checksum(tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for _, x in sorted(tensors.items()):
        digest.update(x.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
