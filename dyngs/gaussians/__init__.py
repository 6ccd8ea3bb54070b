"""Shared by all Gaussian models: values, rendering, initialisation, densification, colour,
Adam."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from dyngs.core.gaussians import Gaussians as Gaussians
from dyngs.core.gaussians import TopologyEdit as TopologyEdit


@dataclass(frozen=True)
class EditResult:
    """A change of the set of Gaussians and of their values."""

    edit: TopologyEdit | None  # how rows move; None where all stay in place
    # field name to its new values (N_new, ...), for the fields that are not just rows moved
    changes: dict[str, Tensor] = field(default_factory=dict[str, Tensor])
    # fields whose optimizer moments start anew in every row
    zero_moments: frozenset[str] = frozenset()
    message: str | None = None  # a line for people about why, or None
