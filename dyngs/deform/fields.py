"""Deformation fields from the configuration, new or from a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from typing_extensions import assert_never

from dyngs.core.state import Role, State, part_of, with_role
from dyngs.core.tensor_checks import require_positive, require_tensor
from dyngs.deform.bodies.field import BodyField
from dyngs.deform.control_nodes import ControlNodes
from dyngs.deform.field import DeformationField, FieldSetup
from dyngs.deform.free import FreePrimitives
from dyngs.deform.hexplane import Hexplane
from dyngs.deform.keys import ControlNodesField, DeformField, FreeField, HexplaneField, MlpField
from dyngs.deform.mlp import Mlp
from dyngs.deform.windows import WindowedField


def new_field(
    options: DeformField, setup: FieldSetup, generator: torch.Generator
) -> DeformationField:
    """Return an untrained field of the kind asked for: every Gaussian stays where it is."""
    match options:
        case HexplaneField():
            return Hexplane(options, setup, generator)
        case MlpField():
            return Mlp(options, setup, generator)
        case ControlNodesField():
            return ControlNodes(options, setup, generator)
        case FreeField():
            return FreePrimitives(options, setup, generator)
        case _:
            assert_never(options)


def num_values(options: DeformField, num_times: int, num_moving: int = 0) -> int:
    """Return the number of values that a field learns for so many Gaussians that move."""
    setup = FieldSetup(
        torch.zeros(3, device="cpu"), torch.ones(3, device="cpu"), num_times, num_moving, 1.0
    )
    return new_field(options, setup, torch.Generator()).parameters.num_values


def field_state(field: DeformationField) -> State:
    """Return the state that ``restored_field`` needs, by name."""
    box = torch.stack([field.setup.center, field.setup.half_size])
    numbers = torch.tensor(
        [field.setup.num_times, field.setup.extent], dtype=torch.float64, device="cpu"
    )
    return field.state() | with_role({"box": box, "numbers": numbers}, Role.SHARED)


def restored_field(
    options: DeformField, tensors: Mapping[str, Tensor], num_moving: int
) -> DeformationField:
    """Return the field of a checkpoint for M moving Gaussians."""
    num_times, extent = require_positive(
        "numbers", require_tensor("numbers", tensors["numbers"], (2,), None)
    ).tolist()
    center, half_size = require_tensor("box", tensors["box"], (2, 3))
    setup = FieldSetup(
        center, require_positive("box", half_size), int(num_times), num_moving, extent
    )
    field = new_field(options, setup, torch.Generator()).restored(tensors)
    bodies = part_of(tensors, "bodies")
    field = BodyField.stored(field, bodies) if bodies else field
    windows = part_of(tensors, "windows")
    return WindowedField.stored(field, windows) if windows else field
