"""Creation and restoration of deformation fields, and opacity windows in time around them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dyngs.core.state import Role, State, add_prefix, select_prefix, with_role
from dyngs.core.tensor_checks import require_positive, require_tensor
from dyngs.deform.bodies.field import BodyField
from dyngs.deform.control_nodes import ControlNodes
from dyngs.deform.field import (
    DeformationField,
    FieldSetup,
    Offsets,
    OuterField,
    select_rows,
)
from dyngs.deform.free import FreePrimitives
from dyngs.deform.gaussians_4d import Gaussians4D
from dyngs.deform.keys import (
    ControlNodesField,
    DeformField,
    FreeField,
    Gaussians4DField,
    HexplaneField,
    MlpField,
)
from dyngs.deform.networks import Hexplane, Mlp
from dyngs.gaussians.optimizer import Parameters
from dyngs.ops.adam import Count

EDGE_WIDTH = 0.05  # time over which the logit falls by 1 outside a window, in units of the clip
# Edges by which an open window exceeds the clip at either end, so that gradients do not vanish.
MARGIN = 3.0
OPEN_WINDOW = -MARGIN * EDGE_WIDTH, 1 + MARGIN * EDGE_WIDTH
LR, LR_DECAY = 1e-2, 0.1


class WindowedField(OuterField):
    """A field that adds a window in time to the opacity logits of an inner field's M Gaussians.

    w(t) = log s((t - a) / e) + log s((b - t) / e), minus the value of an open window. s is the
    logistic function; a and b, the ``edges`` (M, 2), are start and end of the window.
    """

    can_fade = True

    def __init__(self, inner_field: DeformationField, num_moving: int) -> None:
        super().__init__(inner_field)
        edges = torch.tensor(OPEN_WINDOW, device="cpu").expand(num_moving, 2)
        self.parameters = Parameters({"edges": edges}, {"edges": LR}, LR_DECAY, Role.PER_MOVING)

    @property
    def edges(self) -> Tensor:
        return self.parameters["edges"]

    def modify(self, offsets: Offsets, means: Tensor, time: float, rows: Tensor | None) -> Offsets:
        edges = select_rows(self.edges, rows)
        window = _window(edges, time) - _window(edges.new_tensor([OPEN_WINDOW]), time)
        logits = window if offsets.logit_opacities is None else offsets.logit_opacities + window
        return replace(offsets, logit_opacities=logits)

    def step(self, step: int, progress: float) -> Count:
        count = super().step(step, progress)
        self.edges.data[:, 0].clamp_min_(OPEN_WINDOW[0])
        self.edges.data[:, 1].clamp_max_(OPEN_WINDOW[1])
        return count

    def state(self) -> State:
        return self.inner_field.state() | add_prefix("windows", self.parameters.state())

    @staticmethod
    def from_state(inner_field: DeformationField, tensors: Mapping[str, Tensor]) -> WindowedField:
        """Return the windows in a state around the restored ``inner_field``; errors as for
        ``with_state``."""
        field = WindowedField(inner_field, inner_field.setup.num_moving)
        field.parameters = field.parameters.with_state(tensors)
        return field


def _window(edges: Tensor, time: float) -> Tensor:
    inside = torch.stack([time - edges[:, 0], edges[:, 1] - time], dim=1) / EDGE_WIDTH
    return torch.nn.functional.logsigmoid(inside).sum(1)


def create_field(
    options: DeformField, setup: FieldSetup, generator: torch.Generator
) -> DeformationField:
    """Create an untrained field: all offsets are zero."""
    kinds: dict[type, Callable[[Any, FieldSetup, torch.Generator], DeformationField]] = {
        HexplaneField: Hexplane,
        MlpField: Mlp,
        ControlNodesField: ControlNodes,
        FreeField: FreePrimitives,
        Gaussians4DField: Gaussians4D,
    }
    return kinds[type(options)](options, setup, generator)


def num_values(
    options: DeformField, num_times: int, num_moving: int = 0, num_sh_terms: int = 0
) -> int:
    """Return the number of trained values of a field for ``num_moving`` Gaussians."""
    center = torch.zeros(3, device="cpu")
    half_size = torch.ones(3, device="cpu")
    setup = FieldSetup(center, half_size, num_times, num_moving, 1.0, num_sh_terms)
    return create_field(options, setup, torch.Generator()).parameters.num_values


def field_state(field: DeformationField) -> State:
    """Return the state for ``restore_field`` by name."""
    box = torch.stack([field.setup.center, field.setup.half_size])
    numbers = torch.tensor(
        [field.setup.num_times, field.setup.extent], dtype=torch.float64, device="cpu"
    )
    return field.state() | with_role({"box": box, "numbers": numbers}, Role.SHARED)


def restore_field(
    options: DeformField, tensors: Mapping[str, Tensor], num_moving: int, num_sh_terms: int = 0
) -> DeformationField:
    """Return the field in a checkpoint for M moving Gaussians with K harmonics each."""
    num_times, extent = require_positive(
        "numbers", require_tensor("numbers", tensors["numbers"], (2,), None)
    ).tolist()
    center, half_size = require_tensor("box", tensors["box"], (2, 3))
    require_positive("box", half_size)
    num_sh_terms = num_sh_terms if "learned.sh_time" in tensors else 0
    setup = FieldSetup(center, half_size, int(num_times), num_moving, extent, num_sh_terms)
    field = create_field(options, setup, torch.Generator()).with_state(tensors)
    bodies = select_prefix(tensors, "bodies")
    field = BodyField.from_state(field, bodies) if bodies else field
    windows = select_prefix(tensors, "windows")
    return WindowedField.from_state(field, windows) if windows else field
