"""Deformation fields from the configuration, new or from a checkpoint, and the windows in time around them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dyngs.core.state import Role, State, part_of, add_prefix, with_role
from dyngs.core.tensor_checks import require_positive, require_tensor
from dyngs.deform.bodies.field import BodyField
from dyngs.deform.control_nodes import ControlNodes
from dyngs.deform.field import DeformationField, FieldSetup, Offsets, OuterField, select_rows
from dyngs.deform.free import FreePrimitives
from dyngs.deform.keys import ControlNodesField, DeformField, FreeField, HexplaneField, MlpField
from dyngs.deform.networks import Hexplane, Mlp
from dyngs.gaussians import TopologyEdit
from dyngs.gaussians.optimizer import Parameters
from dyngs.ops.adam import Count

EDGE = 0.05  # Time over which the logit falls by 1 outside of a window, in units of the clip
# Edges by which an open window is longer than the clip, at either end: slopes can still be felt
MARGIN = 3.0
OPEN = -MARGIN * EDGE, 1 + MARGIN * EDGE
LR, LR_DECAY = 1e-2, 0.1


class WindowedField(OuterField):
    """The offsets of ``others``, and the window of each of M Gaussians added to the logit of its
    opacity.

    w(t) = log s((t - a) / e) + log s((b - t) / e), less what it is where a window is open: s is the
    logistic function, a and b, the ``edges`` (M, 2), are where the window begins and ends.
    """

    can_fade = True

    def __init__(self, inner_field: DeformationField, num_moving: int) -> None:
        super().__init__(inner_field)
        edges = torch.tensor(OPEN, device="cpu").expand(num_moving, 2)
        self.parameters = Parameters({"edges": edges}, {"edges": LR}, LR_DECAY, Role.PER_MOVING)

    @property
    def edges(self) -> Tensor:
        return self.parameters["edges"]

    def changed(self, found: Offsets, means: Tensor, time: float, rows: Tensor | None) -> Offsets:
        edges = select_rows(self.edges, rows)
        window = _window(edges, time) - _window(edges.new_tensor([OPEN]), time)
        logits = window if found.logit_opacities is None else found.logit_opacities + window
        return replace(found, logit_opacities=logits)

    def step(self, step: int, progress: float) -> Count:
        count = super().step(step, progress)
        self.edges.data[:, 0].clamp_min_(OPEN[0])
        self.edges.data[:, 1].clamp_max_(OPEN[1])
        return count

    def apply_edit(self, edit: TopologyEdit) -> WindowedField:
        return (
            super()
            .apply_edit(edit)
            .with_parameters(self.parameters.apply_edit(Role.PER_MOVING, edit))
        )

    def state(self) -> State:
        return self.inner_field.state() | add_prefix("windows", self.parameters.state())

    @staticmethod
    def from_state(inner_field: DeformationField, tensors: Mapping[str, Tensor]) -> WindowedField:
        """Return the field of a state within the restored ``others``; raises as ``restored``."""
        field = WindowedField(inner_field, inner_field.setup.num_moving)
        field.parameters = field.parameters.with_state(tensors)
        return field


def _window(edges: Tensor, time: float) -> Tensor:
    inside = torch.stack([time - edges[:, 0], edges[:, 1] - time], dim=1) / EDGE
    return torch.nn.functional.logsigmoid(inside).sum(1)


def create_field(
    options: DeformField, setup: FieldSetup, generator: torch.Generator
) -> DeformationField:
    """Return an untrained field of the kind asked for: every Gaussian stays where it is."""
    kinds: dict[type, Callable[[Any, FieldSetup, torch.Generator], DeformationField]] = {
        HexplaneField: Hexplane,
        MlpField: Mlp,
        ControlNodesField: ControlNodes,
        FreeField: FreePrimitives,
    }
    return kinds[type(options)](options, setup, generator)


def num_values(options: DeformField, num_times: int, num_moving: int = 0) -> int:
    """Return the number of values that a field learns for so many Gaussians that move."""
    setup = FieldSetup(
        torch.zeros(3, device="cpu"), torch.ones(3, device="cpu"), num_times, num_moving, 1.0
    )
    return create_field(options, setup, torch.Generator()).parameters.num_values


def field_state(field: DeformationField) -> State:
    """Return the state that ``restored_field`` needs, by name."""
    box = torch.stack([field.setup.center, field.setup.half_size])
    numbers = torch.tensor(
        [field.setup.num_times, field.setup.extent], dtype=torch.float64, device="cpu"
    )
    return field.state() | with_role({"box": box, "numbers": numbers}, Role.SHARED)


def restore_field(
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
    field = create_field(options, setup, torch.Generator()).with_state(tensors)
    bodies = part_of(tensors, "bodies")
    field = BodyField.from_state(field, bodies) if bodies else field
    windows = part_of(tensors, "windows")
    return WindowedField.from_state(field, windows) if windows else field
