"""Dynamic scenes: canonical Gaussians of which a deformation field moves some."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from dyngs.core.state import Role, State, StateTensor, add_prefix, select_prefix
from dyngs.core.tensor_checks import require_ascending, require_indices, require_tensor
from dyngs.deform.field import DeformationField, DeformedGaussians, MovingRows
from dyngs.deform.fields import field_state, restore_field
from dyngs.deform.gaussians_4d import Gaussians4D
from dyngs.deform.keys import DynamicModel
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.filters import apply_filter, filter_state, restore_filter
from dyngs.gaussians.scene import GaussianScene, GaussianTimeStep, restore_times, times_state
from dyngs.gaussians.visibility import VisibilityMasks, intersect_sorted, row_positions
from dyngs.models.renderable import Renderable, clamp_time
from dyngs.ops.quaternions import identity_quat

_NONE = torch.zeros(0, dtype=torch.long, device="cpu")


@dataclass(frozen=True, kw_only=True, repr=False)
class DynamicScene(GaussianScene):
    """N canonical Gaussians, of which a field moves M."""

    training_times: tuple[float, ...]  # distinct training times in [0, 1], ascending
    field: DeformationField | None = None
    moving: Tensor = _NONE  # (M,) ascending indices of the moving Gaussians
    filter_std: Tensor | None = None

    @staticmethod
    def from_state(
        options: DynamicModel, gaussians: Gaussians, tensors: Mapping[str, Tensor]
    ) -> DynamicScene:
        count = len(gaussians)
        own = select_prefix(tensors, "field")
        std = restore_filter(tensors, count)
        times = restore_times(tensors)
        static = DynamicScene(gaussians=gaussians, training_times=times, filter_std=std)
        if not own:
            return static
        masks = VisibilityMasks.from_state(select_prefix(tensors, "masks"), count)
        rows = tensors.get("rows", torch.arange(count, device=gaussians.means.device))
        require_ascending("rows", require_indices("rows", rows, (None,), count))
        field = restore_field(options.deform, own, len(rows), gaussians.sh.shape[1])
        if "left_quats" in own:
            left = require_tensor("left_quats", own["left_quats"], (len(rows), 4))
            gaussians = gaussians.replace(quats=gaussians.quats.index_copy(0, rows, left))
        return replace(static, gaussians=gaussians, field=field, moving=rows, masks=masks)

    @property
    def times(self) -> tuple[float, ...]:
        return self.training_times

    @property
    def is_static(self) -> bool:
        return self.field is None or len(self.moving) == 0

    @property
    def rows(self) -> Tensor:
        return self.moving

    @property
    def offset_rows(self) -> Tensor:
        return self.moving

    @property
    def num_motion_values(self) -> int:
        return 0 if self.field is None or self.is_static else self.field.num_values

    def time_step(self, time: float | None) -> GaussianTimeStep:
        """Return the N Gaussians at ``time``; with masks only the visible ones, in their order.

        Static Gaussians are not recomputed.
        """
        now = clamp_time(time)
        if self.field is None or self.is_static:
            return GaussianTimeStep(apply_filter(self.gaussians, self.filter_std), now)
        part = self._visible_around(now)
        deform = partial(part.deform, self.field, now)
        from_eye = (lambda eye: deform(eye=eye).gaussians) if self.field.depends_on_view else None
        return GaussianTimeStep(deform().gaussians, now, from_eye=from_eye)

    def drawing_step(self, time: float | None) -> GaussianTimeStep:
        """Return ``time_step``; without gradients only the Gaussians that are drawn at ``time``."""
        if self.field is None or self.is_static or torch.is_grad_enabled():
            return self.time_step(time)
        if "lifetimes" not in self._derived:
            moving = self.gaussians.picked(self.moving)
            self._derived["lifetimes"] = self.field.lifetimes(moving)
        lifetimes = self._derived["lifetimes"]
        if lifetimes is None:
            return self.time_step(time)
        now = clamp_time(time)
        is_drawn = torch.ones(len(self), dtype=torch.bool, device=self.device)
        is_drawn[self.moving] = (lifetimes[:, 0] <= now) & (now <= lifetimes[:, 1])
        if self.masks is not None:
            is_drawn &= self.masks.visible(self.masks.interval(now))
        part = self._select(self.gaussians, torch.nonzero(is_drawn)[:, 0])
        return GaussianTimeStep(part.deform(self.field, now).gaussians, now)

    def in_training(
        self, time: float, *, detach: bool, eye: Tensor | None = None
    ) -> DeformedGaussians:
        """Return the Gaussians at ``time``, seen from ``eye`` (3,), with offsets and penalties.

        With ``detach`` only the field gets gradients, not the canonical Gaussians.
        """
        assert self.field is not None
        gaussians = self.gaussians.detach() if detach else self.gaussians
        part = self._select(gaussians, self._active(time))
        return part.deform(self.field, time, in_training=True, eye=eye)

    def apply_edit(self, edit: TopologyEdit) -> DynamicScene:
        descent = row_positions(self.moving, len(self))[edit.source]
        rows = torch.nonzero(descent >= 0)[:, 0]
        field = self.field
        if field is not None:
            field = field.apply_edit(TopologyEdit(descent[rows], edit.is_new[rows]))
        return replace(
            self,
            gaussians=self.gaussians.apply_edit(edit),
            moving=rows,
            field=field,
            masks=None if self.masks is None else self.masks.select(edit.source),
            filter_std=None if self.filter_std is None else edit.apply(self.filter_std),
        )

    def drawing_state(self) -> State:
        """Return the tensors needed for rendering, with equivalent rotations of 4D Gaussians."""
        state = super().drawing_state()
        if isinstance(self.field, Gaussians4D) and len(self.moving):
            quats = self.gaussians.quats.detach()
            left, right = self.field.storage_quats(quats[self.moving])
            if self.field.depends_on_view:  # which multiplies each number of a rotation
                state["model.field.left_quats"] = StateTensor(quats[self.moving], Role.PER_MOVING)
                left = identity_quat(left).expand_as(left)
                right = self.field.parameters["right_quats"].detach()
            left = quats.index_copy(0, self.moving, left)
            state["gaussians.quats"] = StateTensor(left, Role.PER_GAUSSIAN)
            state["model.field.learned.right_quats"] = StateTensor(right, Role.PER_MOVING)
        return state

    def _model_state(self) -> State:
        state = filter_state(self.filter_std) | times_state(self.training_times)
        if self.field is not None:
            state |= add_prefix("field", field_state(self.field))
            state["rows"] = StateTensor(self.moving, Role.SHARED)
        return state if self.masks is None else state | add_prefix("masks", self.masks.state())

    def _active(self, time: float) -> Tensor | None:
        """Return ascending indices (A,) of the Gaussians that the masks show at ``time``; None:
        all."""
        return None if self.masks is None else self.masks.active(self.masks.interval(time))

    def _visible_around(self, time: float) -> _VisiblePart:
        """Return the visible part around ``time``; without gradients the last one is cached."""
        if torch.is_grad_enabled():
            return self._select(self.gaussians, self._active(time))
        interval = 0 if self.masks is None else self.masks.interval(time)
        if self._derived.get("interval") != interval:
            self._derived["interval"] = interval
            self._derived["part"] = self._select(self.gaussians, self._active(time))
        return self._derived["part"]

    def _select(self, gaussians: Gaussians, active: Tensor | None) -> _VisiblePart:
        means = gaussians.means.index_select(0, self.moving)
        if active is None:
            rows = None if len(self.moving) == len(self) else self.moving
            return _VisiblePart(gaussians, self.filter_std, MovingRows(means, None, rows))
        std = None if self.filter_std is None else self.filter_std[active]
        visible_rows, rows = intersect_sorted(self.moving, active, len(self))
        moving = MovingRows(means, visible_rows, rows)
        return _VisiblePart(gaussians.picked(active), std, moving)


def field_scene_of(scene: Renderable) -> DynamicScene | None:
    """Return ``scene`` if a deformation field moves it, else None."""
    return scene if isinstance(scene, DynamicScene) and not scene.is_static else None


@dataclass(frozen=True)
class _VisiblePart:
    """The A Gaussians that are visible around a time."""

    gaussians: Gaussians  # A canonical Gaussians
    filter_std: Tensor | None  # (A,) or None
    moving: MovingRows

    def deform(
        self,
        field: DeformationField,
        time: float,
        *,
        in_training: bool = False,
        eye: Tensor | None = None,
    ) -> DeformedGaussians:
        now = field.deform(self.gaussians, self.moving, time, in_training=in_training, eye=eye)
        filtered = apply_filter(now.gaussians, self.filter_std)
        shaded = field.apply_shading(filtered, self.moving.rows, self.moving.visible, time)
        return replace(now, gaussians=shaded)
