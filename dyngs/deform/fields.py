"""From the configuration to a deformation field, new or from a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from dyngs.config import ControlNodesField, DeformField, HexplaneField, MlpField
from dyngs.deform.field import DeformationField, FieldSetup
from dyngs.deform.hexplane import Hexplane
from dyngs.deform.mlp import Mlp
from dyngs.deform.skeleton import Skeleton
from dyngs.deform.trajectory import Trajectory
from dyngs.tensor_checks import require_positive, require_tensor


def new_field(options: DeformField, setup: FieldSetup, generator: torch.Generator) -> DeformationField:
    """An untrained field of the kind asked for: every Gaussian stays where it is."""
    if isinstance(options, HexplaneField):
        return Hexplane(options, setup, generator)
    if isinstance(options, MlpField):
        return Mlp(options, setup, generator)
    if isinstance(options, ControlNodesField):
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
    """The field of a checkpoint for M moving Gaussians, and its setup.

    Raises:
        KeyError: a tensor lacks.
        ValueError: one is not as a field of these options has it.
    """
    num_times, extent = require_positive("numbers", require_tensor("numbers", state["numbers"], (2,), None)).tolist()
    center, half_size = require_tensor("box", state["box"], (2, 3))
    setup = FieldSetup(center, require_positive("box", half_size), int(num_times), num_moving, extent)
    field = new_field(options, setup, torch.Generator())
    buffers = part_of(state, "buffers.")
    if isinstance(field, Skeleton):
        field.load_state(part_of(state, "learned."), buffers)
    else:
        field.learned.load_state(part_of(state, "learned."))
        field.buffers = buffers
    return field, setup


def part_of(state: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names start with ``prefix``, without it."""
    return {name.removeprefix(prefix): x for name, x in state.items() if name.startswith(prefix)}
