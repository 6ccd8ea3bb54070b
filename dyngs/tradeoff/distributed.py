"""The processes that share a sweep, as started by ``torchrun``.

They may run on several machines that share a file system: they exchange results through files.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import timedelta

import torch

from dyngs.api.train import num_cores
from dyngs.tradeoff.variants import Variant
from dyngs.training.processes import numbers_of_torchrun

TIMEOUT = timedelta(days=30)
"""A process may have to wait while others train."""


@dataclass(frozen=True)
class ProcessGroup:
    """This process and the number of the others.

    Attributes:
        rank: number of this process; rank 0 also measures speed and writes the report.
        size: number of processes.
        local_size: number of processes on this machine.
    """

    rank: int = 0
    size: int = 1
    local_size: int = 1

    @staticmethod
    def from_environment() -> ProcessGroup:
        """Return the group that ``torchrun`` describes in environment variables; a single process without it.

        Raises:
            DyngsError: one of the variables is not a number.
        """
        numbers = numbers_of_torchrun()
        return SINGLE_PROCESS if numbers is None else ProcessGroup(*numbers)

    @property
    def is_first(self) -> bool:
        """Whether this process has rank 0."""
        return self.rank == 0

    @property
    def cores(self) -> int:
        """Cores for this process if all on this machine get the same number, at least 1."""
        return max(1, num_cores() // self.local_size)

    def share(self, variants: Sequence[Variant]) -> list[Variant]:
        """Return the variants for this process; variants that are made from one another stay together."""
        owners: dict[Variant, int] = {}
        for variant in variants:
            owners.setdefault(_longest_stage(variant), len(owners) % self.size)
        return [variant for variant in variants if owners[_longest_stage(variant)] == self.rank]

    def wait(self) -> None:
        """Block until all processes are here."""
        if self.size == 1:
            return
        if not torch.distributed.is_initialized():
            torch.distributed.init_process_group("gloo", timeout=TIMEOUT)
        torch.distributed.barrier()


SINGLE_PROCESS = ProcessGroup()


def _longest_stage(variant: Variant) -> Variant:
    """Return the part of a variant that takes longest to make: training, else pruning and masking, else the rest."""
    pruned = replace(variant.stored, storage=None, field_step=1.0, sh_degree=None)
    return next((part for part in (variant.trained, pruned, variant.stored) if part != Variant()), variant)
