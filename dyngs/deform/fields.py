"""From the configuration to a deformation field, new or from a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from dyngs.config import DeformField, HexplaneField, MlpField, SkeletonField
from dyngs.deform.field import DeformationField, FieldSetup
from dyngs.deform.hexplane import Hexplane
from dyngs.deform.mlp import Mlp
from dyngs.deform.skeleton import Skeleton
from dyngs.deform.trajectory import Trajectory


def new_field(options: DeformField, setup: FieldSetup, generator: torch.Generator) -> DeformationField:
    """An untrained field of the kind asked for: every Gaussian stays where it is."""
    if isinstance(options, HexplaneField):
        return Hexplane(options, setup, generator)
    if isinstance(options, MlpField):
        return Mlp(options, setup, generator)
    if isinstance(options, SkeletonField):
        return Skeleton(options, setup, generator)
    return Trajectory(options, setup, generator)


def field_state(field: DeformationField, setup: FieldSetup) -> dict[str, Tensor]:
    """What ``restored_field`` needs, by name."""
    box = torch.stack([setup.center, setup.half_size])
    numbers = torch.tensor([setup.num_times, setup.extent], dtype=torch.float64)
    state = {f"learned.{name}": x for name, x in field.learned.state().items()}
    state |= {f"buffers.{name}": x for name, x in field.buffers.items()}
    return state | {"box": box, "numbers": numbers}


def restored_field(
    options: DeformField, state: Mapping[str, Tensor], num_moving: int
) -> tuple[DeformationField, FieldSetup]:
    """The field of a checkpoint for M moving Gaussians, and its setup. Raises KeyError where something is missing."""
    num_times, extent = state["numbers"].tolist()
    setup = FieldSetup(state["box"][0], state["box"][1], int(num_times), num_moving, extent)
    field = new_field(options, setup, torch.Generator())
    field.learned.load_state(part_of(state, "learned."))
    field.buffers = part_of(state, "buffers.")
    return field, setup


def part_of(state: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names start with ``prefix``, without it."""
    return {name.removeprefix(prefix): x for name, x in state.items() if name.startswith(prefix)}
