"""Code shared by all Gaussian models: rendering, initialisation, densification, colour, optimiser."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from dyngs.core.gaussians import Gaussians as Gaussians
from dyngs.core.gaussians import TopologyEdit as TopologyEdit


@dataclass(frozen=True)
class EditResult:
    """A topology edit and new values of the Gaussians after it."""

    edit: TopologyEdit | None  # source row of every new row; None: the topology does not change
    # new values (N_new, ...) by field name, for fields that are not simply gathered from source
    # rows
    changes: dict[str, Tensor] = field(default_factory=dict[str, Tensor])
    # fields whose Adam moments are reset to zero in every row
    zero_moments: frozenset[str] = frozenset()
    message: str | None = None  # log message that explains the edit, or None
    # new values (N_new, ...) of the motion of Gaussians by name; rows of static ones are ignored
    motion_changes: dict[str, Tensor] = field(default_factory=dict[str, Tensor])
