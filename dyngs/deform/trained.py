"""A trained scene: Gaussians at any time."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from dyngs.colour.network import ColourNetwork
from dyngs.config import DynamicModel
from dyngs.deform.field import DeformationField, deformed
from dyngs.deform.fields import part_of, restored_field
from dyngs.deform.masks import KeyMasks, matched
from dyngs.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.rendering import Shader
from dyngs.static.filters import fuse_filter
from dyngs.tensor_checks import require_ascending, require_indices, require_moments, require_tensor


@dataclass(frozen=True)
class TrainedScene:
    """What a run has learned.

    Attributes:
        gaussians: N canonical Gaussians; those of a still scene are what is drawn.
        rows: (M,) indices of those that move, ascending.
        field: what moves them; None where nothing moves.
        filter_std: (N,) of Mip-Splatting's 3D filter, or None.
        times: distinct training times in [0, 1], ascending; empty for a capture without times.
        colour: what colours them; None: their harmonics.
        masks: which of the Gaussians are seen around a time; None: all may be, at all times.
    """

    gaussians: Gaussians
    rows: Tensor
    field: DeformationField | None = None
    filter_std: Tensor | None = None
    times: tuple[float, ...] = ()
    colour: ColourNetwork | None = None
    masks: KeyMasks | None = None
    _kept: dict[int, _Around] = dataclasses.field(default_factory=dict, init=False, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.gaussians)

    @property
    def is_still(self) -> bool:
        """Nothing moves: ``at`` returns the same at every time."""
        return self.field is None or len(self.rows) == 0

    @property
    def moving_share(self) -> float:
        """M / N."""
        return 0.0 if self.is_still else len(self.rows) / max(len(self), 1)

    @property
    def num_field_values(self) -> int:
        """How many numbers the field holds."""
        if self.field is None or self.is_still:
            return 0
        return self.field.learned.num_values + sum(x.numel() for x in self.field.buffers.values())

    @torch.no_grad()
    def at(self, time: float | None) -> Gaussians:
        """The Gaussians at ``time``, clamped to [0, 1]; None is 0. What is still is not computed anew.

        All N of them; with masks only those that are seen around then, in their order.

        Raises:
            DyngsError: the time is NaN.
        """
        if time is not None and math.isnan(time):
            raise DyngsError("the time to draw is not a number; give one from 0 to 1")
        moment = min(max(0.0 if time is None else time, 0.0), 1.0)
        drawn, std = self.gaussians, self.filter_std
        if self.field is not None and not self.is_still:
            around = self._around(moment)
            drawn, std = around.gaussians, around.filter_std
            offsets = self.field.offsets(around.moving_means, moment, around.asked)
            drawn = deformed(drawn, offsets, around.rows)
        return drawn if std is None else fuse_filter(drawn, std)

    def _around(self, time: float) -> _Around:
        """What is drawn around ``time``; that of the last interval is kept."""
        interval = 0 if self.masks is None else self.masks.interval(time)
        if interval not in self._kept:
            self._kept.clear()
            self._kept[interval] = self._selected(interval)
        return self._kept[interval]

    def _selected(self, interval: int) -> _Around:
        means = self.gaussians.means[self.rows]
        if self.masks is None:
            rows = None if len(self.rows) == len(self) else self.rows
            return _Around(self.gaussians, self.filter_std, means, None, rows)
        active = self.masks.active(interval)
        std = None if self.filter_std is None else self.filter_std[active]
        asked, rows = matched(self.rows, active, len(self))
        return _Around(self.gaussians.select(active), std, means, asked, rows)

    def shader_at(self, time: float | None) -> Shader | None:
        """What colours the Gaussians of ``at(time)``; None: their harmonics."""
        return None if self.colour is None else self.colour.shader(time)

    def part(self, which: Literal["moving", "still"]) -> TrainedScene:
        """Only the Gaussians that move, with their field, or only those that do not."""
        moves = torch.zeros(len(self), dtype=torch.bool)
        moves[self.rows] = not self.is_still
        index = torch.nonzero(moves if which == "moving" else ~moves)[:, 0]
        std = None if self.filter_std is None else self.filter_std[index]
        rows, field = (torch.arange(len(index)), self.field) if which == "moving" else (torch.zeros(0).long(), None)
        return replace(self, gaussians=self.gaussians.select(index), rows=rows, field=field, filter_std=std, masks=None)

    def unmasked(self) -> TrainedScene:
        """The same with all Gaussians at all times."""
        return replace(self, masks=None)


@dataclass(frozen=True)
class _Around:
    """What is drawn around a time: Gaussians with the filter, canonical means of all that move, and who of them.

    ``asked`` are those of the moving that are drawn, ``rows`` where they are drawn; None: all.
    """

    gaussians: Gaussians
    filter_std: Tensor | None
    moving_means: Tensor
    asked: Tensor | None
    rows: Tensor | None


def trained_scene(gaussians: Gaussians, model_state: Mapping[str, Tensor], options: object) -> TrainedScene:
    """The scene of a checkpoint: its Gaussians, the state of its model, and the options of that model.

    Raises:
        KeyError: the state lacks a tensor.
        ValueError: a tensor is not as the others and the options have it.
    """
    count = len(gaussians)
    std = model_state.get("filter_std")
    if std is not None and bool((require_tensor("filter_std", std, (count,)) < 0).any()):
        raise ValueError("'filter_std' holds negative numbers")
    times = tuple(require_moments("times", model_state["times"]).tolist()) if "times" in model_state else ()
    part = part_of(model_state, "field.")
    nothing = torch.zeros(0, dtype=torch.long)
    if not part or not isinstance(options, DynamicModel):
        return TrainedScene(gaussians, nothing, None, std, times)
    masks = KeyMasks.restored(part_of(model_state, "masks."), count)
    rows = model_state.get("rows", torch.arange(count))
    require_ascending("rows", require_indices("rows", rows, (None,), count))
    motion, _ = restored_field(options.deform, part, len(rows))
    return TrainedScene(gaussians, rows, motion, std, times, masks=masks)
