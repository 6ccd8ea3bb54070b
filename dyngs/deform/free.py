"""Free primitives: each moving Gaussian has its own time, lifetime and velocity.

After FreeTimeGS (Wang et al. 2025). Windows are added to the opacity logits, so that opaque
Gaussians stay opaque for most of their lifetime. Nothing links time steps: objects that appear,
change shape or move fast are learned from the views at their time alone, which should be several.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.core.state import Role
from dyngs.deform.field import (
    DeformationField,
    FieldSetup,
    Offsets,
    OpacityWindow,
    select_rows,
)
from dyngs.deform.initial_motion import TimedGaussians
from dyngs.deform.keys import COPIES_OF_MOVING, FreeField
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.optimizer import Parameters

MIN_SPAN = 0.25  # shortest lifetime in time steps; shorter ones would flicker
TIME_SHIFT = 0.5  # lifetimes by which a new Gaussian is shifted in time from its source
LR_CENTERS, LR_SPANS, LR_VELOCITIES = 0.01, 0.01, 1e-4
"""Learning rates: centres in time steps, log lifetimes, velocities in scene extents per time step.
"""
LR_DECAY = 0.1  # ratio of the last to the first learning rate
FIRST_SPAN = 0.6  # lifetime of a Gaussian at a single time, in time steps; half opaque after 1.3
RANDOM_SPAN = 0.25  # lifetime of random Gaussians, in units of the clip
STATIC_SPAN = 1.0  # lifetime of static Gaussians, in units of the clip
FAINT_LOGIT = -2.2
"""Initial opacity logit (opacity 0.1) of copies of static Gaussians, if there are timed Gaussians.
"""
NAMES = "centers", "origins", "log_spans", "velocities"


class FreePrimitives(DeformationField):
    """x(t) = x + v (t - o) and logit(t) = logit - (t - c)^2 / (2 d^2) for each of M Gaussians.

    c is the centre of its window, d the lifetime, v the velocity. o, the time of its canonical
    position, is not trained, so that the window can shift without the path.
    """

    has_lifetime = can_fade = True

    def __init__(self, options: FreeField, setup: FieldSetup, generator: torch.Generator) -> None:
        self.options, self.setup = options, setup
        self.gap = 1 / max(setup.num_times - 1, 1)
        centers = torch.rand((setup.num_moving, 1), generator=generator, device="cpu")
        velocities = torch.zeros(len(centers), 3, device="cpu")
        self.parameters = self._untrained(centers, torch.ones_like(centers), velocities)

    def with_initialization(self, start: FreeInitialization) -> FreePrimitives:
        """Return an untrained field with the windows and velocities of ``start``."""
        return self.with_parameters(
            self._untrained(start.centers[:, None], start.spans[:, None], start.velocities)
        )

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        centers, origins, log_spans, velocities = (
            select_rows(self.parameters[name], rows) for name in NAMES
        )
        shift = velocities * (time - origins.detach())
        spans = log_spans.exp() + MIN_SPAN * self.gap
        window = -0.5 * ((time - centers) / spans).square()
        return Offsets(shift, logit_opacities=window[:, 0])

    def opacity_window(self, gaussians: Gaussians, time: float) -> OpacityWindow:
        spans = self.parameters["log_spans"].detach()[:, 0].double().exp() + MIN_SPAN * self.gap
        elapsed = (time - self.parameters["centers"].detach()[:, 0].double()) / spans
        logits = gaussians.logit_opacities.double().clamp_min(-100)
        opacity = (logits - 0.5 * elapsed.square()).sigmoid()
        # The second derivative of the sigmoid of the logits, by the chain rule
        bend = (1 - 2 * opacity) * elapsed.square() - 1
        curvature = opacity * (1 - opacity) * bend / spans.square() / logits.sigmoid()
        return OpacityWindow(curvature, spans.log())

    def apply_edit(self, edit: TopologyEdit) -> FreePrimitives:
        """Return the field after a topology edit; new rows are shifted in time, alternately back
        and forth."""
        field = super().apply_edit(edit)
        new = torch.nonzero(edit.is_new)[:, 0]
        if len(new):
            # two copies of one source get opposite signs
            ordered = new[edit.source[new].sort(stable=True).indices]
            signs = torch.ones(len(new), 1, device=new.device)
            signs[::2] = -1
            spans = field.parameters["log_spans"].data[ordered].exp() + MIN_SPAN * self.gap
            centers = field.parameters["centers"].data
            centers[ordered] = (centers[ordered] + TIME_SHIFT * spans * signs).clamp(0, 1)
        return field

    def _untrained(self, centers: Tensor, spans: Tensor, velocities: Tensor) -> Parameters:
        log_spans = (spans - MIN_SPAN * self.gap).clamp_min(1e-3 * self.gap).log()
        tensors = {
            "centers": centers,
            "origins": centers.clone(),
            "log_spans": log_spans,
            "velocities": velocities,
        }
        rates = {
            "centers": LR_CENTERS * self.gap,
            "origins": 0.0,
            "log_spans": LR_SPANS,
            "velocities": LR_VELOCITIES * self.setup.extent / self.gap,
        }
        return Parameters(tensors, rates, LR_DECAY, Role.PER_MOVING)


@dataclass(frozen=True)
class FreeInitialization:
    """Gaussians that are added when motion starts, and windows of all M moving Gaussians.

    The moving Gaussians of the static model come first.
    """

    logits: Tensor  # (M0,) new opacity logits of the moving Gaussians of the static model
    added: tuple[Gaussians, ...]
    centers: Tensor  # (M,) centre of the window, in units of the clip
    spans: Tensor  # (M,) lifetime, in units of the clip
    velocities: Tensor  # (M, 3) world units per clip

    def with_static(self, moving: Tensor, num_static: int) -> FreeInitialization:
        """Return the windows of all Gaussians: those of the static model first, at ``moving``
        (M0,) as before, else as long as the clip."""

        def spread(values: Tensor, fill: float) -> Tensor:
            before = values.new_full((num_static, *values.shape[1:]), fill)
            before[moving.to(values.device)] = values[: len(moving)]
            return torch.cat([before, values[len(moving) :]])

        return replace(
            self,
            centers=spread(self.centers, 0.5),
            spans=spread(self.spans, STATIC_SPAN),
            velocities=spread(self.velocities, 0.0),
        )


def initialize_free(
    static: Gaussians, timed_gaussians: Sequence[TimedGaussians], others: Gaussians, num_times: int
) -> FreeInitialization:
    """Initialise free primitives: copies of the moving ``static`` Gaussians, timed and random
    Gaussians.

    The copies split the clip evenly. Timed Gaussians last about one time step, ``others`` a
    quarter of the clip, at evenly spaced times.
    """
    copies = min(num_times, max(COPIES_OF_MOVING // max(len(static), 1), 1))
    faint = static.replace(
        logit_opacities=static.logit_opacities.clamp_max(
            FAINT_LOGIT if timed_gaussians else math.inf
        )
    )
    no_motion = torch.zeros(len(faint), 3, device="cpu")
    parts = [TimedGaussians((i + 0.5) / copies, faint, no_motion) for i in range(copies)]
    groups = [*parts, *timed_gaussians]
    sizes = torch.tensor([len(one.gaussians) for one in groups], device="cpu")
    centers = torch.tensor([one.time for one in groups], device="cpu")
    spans = torch.full_like(centers, FIRST_SPAN / max(num_times - 1, 1))
    spans[:copies] = 1 / copies
    velocities = torch.cat([one.velocities for one in groups])
    other_times = torch.linspace(0, 1, len(others), device="cpu")
    return FreeInitialization(
        faint.logit_opacities,
        (*(one.gaussians for one in groups[1:]), others),
        torch.cat([centers.repeat_interleave(sizes), other_times]),
        torch.cat([spans.repeat_interleave(sizes), torch.full_like(other_times, RANDOM_SPAN)]),
        torch.cat([velocities, torch.zeros(len(others), 3, device="cpu")]),
    )
