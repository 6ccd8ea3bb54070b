"""Several processes that share the work of one sweep, as ``torchrun`` starts them.

They may run on several machines that see the same folder: all that they tell each other is in files.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import timedelta

import torch

from dyngs.api.train import num_cores
from dyngs.errors import DyngsError
from dyngs.tradeoff.variants import Variant

PATIENCE = timedelta(days=30)
"""That one process waits for the others, which may be training."""


@dataclass(frozen=True)
class ProcessGroup:
    """This process among all.

    Attributes:
        rank: its number; the first, 0, also measures speed and writes the report.
        size: how many there are.
        here: how many of them are on this machine.
    """

    rank: int = 0
    size: int = 1
    here: int = 1

    @staticmethod
    def from_environment() -> ProcessGroup:
        """What ``torchrun`` says; one process without it.

        Raises:
            DyngsError: a variable of torchrun's is no number.
        """
        names = ("RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE")
        if any(name not in os.environ for name in (*names, "MASTER_ADDR", "MASTER_PORT")):
            return SINGLE_PROCESS
        try:
            return ProcessGroup(*(int(os.environ[name]) for name in names))
        except ValueError:
            raise DyngsError(f"{', '.join(names)} must be numbers, as torchrun sets them") from None

    @property
    def is_first(self) -> bool:
        """This process is the first."""
        return self.rank == 0

    @property
    def cores(self) -> int:
        """This process' share of the machine's, at least 1."""
        return max(1, num_cores() // self.here)

    def share(self, variants: Sequence[Variant]) -> list[Variant]:
        """Those that this process measures; what is made together, or one from the other, stays together."""
        owners: dict[Variant, int] = {}
        for variant in variants:
            owners.setdefault(_made_with(variant), len(owners) % self.size)
        return [variant for variant in variants if owners[_made_with(variant)] == self.rank]

    def wait(self) -> None:
        """Until all are here."""
        if self.size == 1:
            return
        if not torch.distributed.is_initialized():
            torch.distributed.init_process_group("gloo", timeout=PATIENCE)
        torch.distributed.barrier()


SINGLE_PROCESS = ProcessGroup()


def _made_with(variant: Variant) -> Variant:
    """The part of a variant that takes longest to make: training, then pruning and masking, then the rest."""
    compacted = replace(variant.stored, storage=None, field_step=1.0, sh_degree=None)
    return next((part for part in (variant.trained, compacted, variant.stored) if part != Variant()), variant)
