"""Instant-NGP in training: as many rays as fill a step with samples, cells kept up to date, and its
schedule."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyngs.baselines.fields.frusta import seen_cells
from dyngs.baselines.fields.keys import NgpModel
from dyngs.baselines.fields.ngp import NgpField, NgpSizes
from dyngs.baselines.fields.occupancy import Occupancy
from dyngs.baselines.fields.scene import stored_space
from dyngs.baselines.fields.training import FieldTraining, smooth_l1
from dyngs.core.errors import DyngsError
from dyngs.core.state import Role, State, prefixed, with_role
from dyngs.core.tensor_checks import require_tensor
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import RunStart
from dyngs.models.model import Updated
from dyngs.ops.adam import AdamUpdate, seen_rows

FIRST_SAMPLES = 256  # Samples that a ray is taken to need before any was counted
MOST_RAYS = 1 << 15  # Of an image in a step
LOOKED_AT = 2  # Random cells looked at in an update of the occupied ones, per sample of a step
WARM_UP, FIRST_RATE = 100, 0.01  # Steps in which the rate rises from this fraction of itself
DROPS = (0.5, 0.75, 0.9)
DROP = 0.33  # Fractions of the run at which the rate falls by this factor


class NgpTraining(FieldTraining[NgpField]):
    """See the module."""

    def __init__(self, run: RunStart, field: NgpField, model: NgpModel) -> None:
        super().__init__(run, field, smooth_l1)
        self._model, self._num_samples = model, NgpSizes.of(model, field.pixels).num_samples
        self._wanted = max(1, self._num_samples // self._batch)
        self._occupancy = self._new_occupancy(field)
        field.occupied.copy_(self._occupancy.seen)
        # rays and samples of this step
        self._counted = torch.zeros(2, dtype=torch.float64, device="cpu")
        self._rays = max(1, self._wanted // FIRST_SAMPLES)

    def _new_occupancy(self, field: NgpField) -> Occupancy:
        seen = seen_cells(field.space, self._run.capture.splits["train"])
        if not bool(seen.any()):
            raise DyngsError(
                f"{self._run.config.data.root}: no training camera sees anything of the cube that the field lies in: "
                "give model.half_extent, or model.surroundings=always"
            )
        return Occupancy(field.space, seen, LOOKED_AT * self._num_samples)

    @property
    def betas(self) -> tuple[float, float]:
        return 0.9, 0.99

    @property
    def num_rays(self) -> int:
        return self._rays

    def counted(self, num_rays: int, num_samples: int) -> None:
        self._counted += torch.tensor([num_rays, num_samples], dtype=torch.float64, device="cpu")

    def tallies(self, step: int) -> Sequence[Tensor]:
        return [self._counted]

    def rate(self, step: int) -> float:
        rising = min(1.0, FIRST_RATE + (1 - FIRST_RATE) * (step - 1) / WARM_UP)
        fallen = sum(step > fraction * self._run.config.train.steps for fraction in DROPS)
        return self._model.lr * rising * DROP**fallen

    def update(self, step: int) -> Updated:
        for name, x in self._field.parameters.items():
            if name != "table" and x.grad is not None:
                x.grad.add_(x.detach(), alpha=self._model.weight_decay)
        updated = super().update(step)
        if self._occupancy.is_due(step):
            occupied = self._occupancy.updated(
                self._field, step, self._like.seen_at, self._run.generator
            )
            self._field.occupied.copy_(occupied)
        rays, samples = self._counted.tolist()
        self._rays = max(1, min(MOST_RAYS, int(rays * self._wanted / max(samples, 1.0))))
        self._counted.zero_()
        return updated

    def _update_of(self, name: str, x: Tensor, rate: float) -> AdamUpdate | None:
        """Return the update; rows of the grid that no sample touched stay as they are."""
        rows = seen_rows(x.grad) if name == "table" and x.grad is not None else None
        return self._adam.update(name, x, rate, rows)

    def state(self) -> State:
        own = self._occupancy.state() | {"rays": torch.tensor([self._rays], device="cpu")}
        return super().state() | prefixed("occupancy", with_role(own, Role.TRAINING))

    def restored_field(self, checkpoint: Checkpoint) -> NgpField:
        return NgpField.restored(self._model, stored_space(checkpoint.part("field")), checkpoint)

    def restore(self, checkpoint: Checkpoint) -> None:
        before = self._field.space
        super().restore(checkpoint)
        stored = checkpoint.part("occupancy")
        if self._field.space != before:  # to find what cameras see takes seconds
            self._occupancy = self._new_occupancy(self._field)
        self._occupancy.load_state(stored)
        self._rays = min(
            MOST_RAYS, max(1, int(require_tensor("rays", stored["rays"], (1,), torch.int64)))
        )

    def place(self, device: torch.device) -> None:
        super().place(device)
        self._occupancy.place(device)
