"""The dynamic model as the trainer sees it: canonical Gaussians, a field that moves some of them, and which ones.

Training goes through three phases: coarse (nothing moves), fine (the field moves all Gaussians), and from the first
split on the field moves only those whose motion can be seen; the others are frozen and cost nothing more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.config import DynamicModel
from dyngs.data.loader import Picture
from dyngs.deform.field import DeformationField, FieldSetup, Offsets, deformed
from dyngs.deform.fields import field_state, new_field, part_of, restored_field
from dyngs.deform.masks import KeyMasks, matched
from dyngs.deform.motion import bake_, measure_motion
from dyngs.deform.residual import Residuals, two_group_threshold
from dyngs.deform.seeds import box_of, seeded
from dyngs.deform.window import TimeWindow
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.static.densify import EditResult
from dyngs.static.filters import FILTER_VARIANCE, filter_std
from dyngs.static.model import Drawn, StaticScene
from dyngs.static.rates import Rates

NOBODY = torch.zeros(0, dtype=torch.long)
SURELY_MOVING = 1.5
"""Errors so many times ``motion_threshold`` are never taken for those of still things."""
SURELY_STILL = 0.25
"""Where cameras stay in place, errors of so many times ``motion_threshold`` are those of still things."""
MIN_MOVING_SHARE = 0.02
"""If no larger share of the Gaussians surely moves, nothing does."""


@dataclass(frozen=True)
class DeformSchedule:
    """When the phases begin, in steps of this run.

    Attributes:
        fine: last step without motion.
        opens, full: steps between which the window of times grows, to all of them.
        decays: step from which the field's rates fall.
        splits: steps after which Gaussians that do not move are frozen.
        rates: how the field's rates fall.
    """

    fine: int
    opens: int
    full: int
    decays: int
    splits: tuple[int, ...]
    rates: Rates


@dataclass(frozen=True)
class Surroundings4D:
    """What the model needs to know of its capture.

    Attributes:
        times: of the training views, in [0, 1], ascending; at least two differ.
        cameras: the training cameras.
        extent: of the scene, world units.
        residuals: how far its pictures disagree with what is still, where N Gaussians are seen.
        cameras_stay: in place, so that pictures show what is still exactly alike.
    """

    times: tuple[float, ...]
    cameras: Sequence[Cameras]
    extent: float
    residuals: Callable[[Callable[[float], Gaussians]], Residuals]
    cameras_stay: bool = False


class DynamicScene:
    """Gaussians that a field moves.

    Attributes:
        field: None before the fine phase, and for good if nothing moves.
        rows: (M,) indices of the Gaussians that it moves, ascending.
        times: distinct training times, ascending.
        window: which of them are trained on.
        masks: which Gaussians are seen around a time; None: all may be, at all times.
    """

    def __init__(
        self,
        options: DynamicModel,
        schedule: DeformSchedule,
        capture: Surroundings4D,
        still: StaticScene,
        generator: torch.Generator,
    ) -> None:
        self.options, self.schedule, self.capture = options, schedule, capture
        self.times = tuple(sorted(set(capture.times)))
        phases = schedule.fine, schedule.opens, schedule.full
        self.window = TimeWindow.around_middle(capture.times, options.time_window, *phases)
        self.field: DeformationField | None = None
        self.masks: KeyMasks | None = None
        self.rows = NOBODY
        self._still, self._generator = still, generator
        self._setup: FieldSetup | None = None

    def trains_on(self, time: float | None, step: int) -> bool:
        """Whether ``time`` lies in the window of ``step``."""
        return self.window.holds(time or 0.0, step)

    def gaussians_at(self, parameters: Gaussians, batch: Picture, step: int) -> Drawn:
        """What is drawn for ``batch`` at its time, and the regularizers of motion; differentiable."""
        if self.field is None:
            return self._still.gaussians_at(parameters, batch, step)
        if self.window.tracks(step):
            parameters = parameters.detach()
        means = parameters.means.index_select(0, self.rows)
        time = self._jittered(batch.time or 0.0, step)
        asked, rows, active = None, self.rows, None
        if self.masks is not None:
            active = self.masks.active(self.masks.interval(time))
            asked, rows = matched(self.rows, active, len(parameters))
            parameters = picked(parameters, active)
        offsets = self.field.offsets(means, time, asked)
        moved = deformed(parameters, offsets, rows)
        drawn = (
            self._still.gaussians_at(moved, batch, step).gaussians
            if active is None
            else self._still.filtered(moved, active)
        )
        return Drawn(drawn, self.field.penalties(time) | self._sparsity(offsets))

    def after_step(self, parameters: Gaussians, step: int, result: EditResult | None) -> int:
        """Rows left out for bad gradients; optimizes the field, follows ``result``, begins the next phase."""
        self._still.after_step(parameters, step, result)
        left_out = 0
        if self.field is not None:
            progress = self.schedule.rates.progress(step, since=self.schedule.decays)
            left_out = self.field.learned.step(step - self.schedule.fine, progress)
            if result is not None and result.edit is not None:
                self._follow(result.edit, self.field)
        if self.field is not None:
            self.field.extend(self.window.bounds(step), self.window.bounds(step + 1))
            if step in self.schedule.splits:
                self._freeze(parameters, self.field)
        return left_out

    def edit(self, parameters: Gaussians, step: int) -> EditResult | None:
        """Random Gaussians to begin motion with, after the coarse phase; None where a still model explains all."""
        if step != self.schedule.fine:
            return None
        found = self.capture.residuals(lambda _: parameters)
        floor = self.options.motion_threshold
        if not bool((found.most > SURELY_MOVING * floor).float().mean() > MIN_MOVING_SHARE):
            return None
        threshold = min(max(two_group_threshold(found.usual), floor), SURELY_MOVING * floor)
        rows = torch.nonzero(found.usual > threshold)[:, 0]
        result = seeded(parameters.detach(), self.options.num_random_moving, self.capture.extent, self._generator)
        added = torch.arange(len(parameters), len(parameters) + self.options.num_random_moving)
        self._begin_motion(parameters, torch.cat([rows, added]))
        self._still.after_step(Gaussians(**result.changes), step, result)
        return result

    def num_moving(self, num_gaussians: int) -> int:
        """M of N Gaussians."""
        return len(self.rows)

    def state(self) -> dict[str, Tensor]:
        state = self._still.state() | {"times": torch.tensor(self.times, dtype=torch.float64)}
        if self.field is not None and self._setup is not None:
            state |= {f"field.{name}": x for name, x in field_state(self.field, self._setup).items()}
            state["rows"] = self.rows
        if self.masks is not None:
            state |= {f"masks.{name}": x for name, x in self.masks.state().items()}
        return state

    def load_state(self, state: dict[str, Tensor]) -> None:
        self._still.load_state(state)
        self.rows = state.get("rows", NOBODY)
        self.masks = KeyMasks.restored(part_of(state, "masks."))
        part = part_of(state, "field.")
        self.field = self._setup = None
        if part:
            self.field, self._setup = restored_field(self.options.deform, part, len(self.rows))

    def _begin_motion(self, parameters: Gaussians, rows: Tensor) -> None:
        center, half_size = box_of(parameters, self.capture.extent)
        setup = FieldSetup(center, half_size, len(self.times), len(rows), self.capture.extent)
        self.rows, self._setup = rows, setup
        self.field = new_field(self.options.deform, setup, self._generator)

    def _freeze(self, parameters: Gaussians, field: DeformationField) -> None:
        """Stop moving the Gaussians whose motion is too small to be seen."""
        now = parameters.detach()
        px_size = filter_std(now.means, self.capture.cameras)[self.rows] / math.sqrt(FILTER_VARIANCE)
        motion = measure_motion(field, now.select(self.rows), self.times, px_size)
        moves = motion.pixels >= self.options.freeze_below_px
        if self.capture.cameras_stay:
            means = now.means[self.rows]
            seen = self.capture.residuals(lambda time: deformed(now, field.offsets(means, time), self.rows))
            moves &= seen.usual[self.rows] > SURELY_STILL * self.options.motion_threshold
        still = torch.nonzero(~moves)[:, 0]
        bake_(parameters, self.rows[still], motion.mean.select(still))
        kept = torch.nonzero(moves)[:, 0]
        self.rows = self.rows[kept]
        field.select(kept, torch.zeros(len(kept), dtype=torch.bool))
        if not len(kept):
            self.field = self._setup = None

    def _follow(self, edit: TopologyEdit, field: DeformationField) -> None:
        """Let rows and field follow a change of the set: descendants of what moves move."""
        num_old = 1 + max(int(x.max()) if len(x) else 0 for x in (edit.source, self.rows))
        position = torch.full((num_old,), -1)
        position[self.rows] = torch.arange(len(self.rows))
        descent = position[edit.source]
        self.rows = torch.nonzero(descent >= 0)[:, 0]
        field.select(descent[self.rows], edit.is_new[self.rows])
        if self.masks is not None:
            self.masks = self.masks.select(edit.source)

    def _jittered(self, time: float, step: int) -> float:
        """``time`` with the annealed noise of Deformable-3DGS, against frames that overfit."""
        if self.options.time_jitter == 0:
            return time
        gap = 1 / max(len(self.times) - 1, 1)
        noise = float(torch.randn((), generator=self._generator)) * self.options.time_jitter * gap
        return min(max(time + noise * max(0.0, 1 - step / self.schedule.rates.steps), 0.0), 1.0)

    def _sparsity(self, offsets: Offsets) -> dict[str, Tensor]:
        """Mean motion: what need not move should not."""
        if self.options.motion_sparsity == 0 or not len(offsets.means):
            return {}
        tiny = 1e-6 * self.capture.extent
        length = (offsets.means.square().sum(1) + tiny**2).sqrt().mean()
        return {"motion sparsity": length * (self.options.motion_sparsity / self.capture.extent)}


def picked(gaussians: Gaussians, rows: Tensor) -> Gaussians:
    """The Gaussians at ``rows``; differentiable, and its gradient costs less than that of indexing."""
    return Gaussians(**{name: x.index_select(0, rows) for name, x in gaussians.tensors().items()})
