"""Free primitives: each moving Gaussian has its own moment, span and velocity, and is not there
before and after.

After FreeTimeGS (Wang et al. 2025), with windows that are added to the logit of the opacity, so
that what is opaque is equally so for most of its span. Nothing ties one time to another: what comes
and goes, changes shape or travels by more than its own size is learned from the views of its times
alone, which should be several.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.core.state import Role
from dyngs.deform.field import DeformationField, FieldSetup, Offsets, select_rows
from dyngs.deform.fixed_cameras.initial_motion import TimedGaussians
from dyngs.deform.keys import COPIES_OF_MOVING, FreeField
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.optimizer import Parameters

SHORTEST = 0.25  # Least span, in gaps between times: less would flicker between them
SHIFT = 0.5  # Spans by which a new Gaussian is earlier or later than the one it descends from
LR_CENTERS, LR_SPANS, LR_VELOCITIES = 0.01, 0.01, 1e-4
"""Learning rates: in gaps between times, of the logarithm, in scene extents per gap."""
LR_DECAY = 0.1  # Ratio of the last to the first learning rate
FIRST_SPAN = 0.6  # Of a Gaussian at a single time, in gaps: at 1.3 of them it is half as opaque
OTHERS_SPAN = 0.25  # Of Gaussians that may belong to any time, in units of the clip
FAINT = -2.2
"""Logit of the opacity, 0.1, at which copies of static Gaussians begin where there are moments:
most are ghosts."""
NAMES = "centers", "origins", "log_spans", "velocities"


class FreePrimitives(DeformationField):
    """x(t) = x + v (t - o) and logit(t) = logit - (t - c)^2 / (2 d^2) for each of M Gaussians.

    c is the centre of its window, d the span, v the velocity; o, the time at which it is at its
    canonical place, is not learned: a window may shift without its path.
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
        spans = log_spans.exp() + SHORTEST * self.gap
        window = -0.5 * ((time - centers) / spans).square()
        return Offsets(shift, logit_opacities=window[:, 0])

    def apply_edit(self, edit: TopologyEdit) -> FreePrimitives:
        """Return the field after an edit; new rows are earlier and later in turn than those they
        descend from."""
        parameters = self.parameters.apply_edit(Role.PER_MOVING, edit)
        new = torch.nonzero(edit.is_new)[:, 0]
        if len(new):
            # two of one source get both signs
            ordered = new[edit.source[new].sort(stable=True).indices]
            signs = torch.ones(len(new), 1, device=new.device)
            signs[::2] = -1
            spans = parameters["log_spans"].data[ordered].exp() + SHORTEST * self.gap
            centers = parameters["centers"].data
            centers[ordered] = (centers[ordered] + SHIFT * spans * signs).clamp(0, 1)
        return self.with_parameters(parameters)

    def _untrained(self, centers: Tensor, spans: Tensor, velocities: Tensor) -> Parameters:
        log_spans = (spans - SHORTEST * self.gap).clamp_min(1e-3 * self.gap).log()
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
    """Gaussians to add when motion begins, and windows of all M that move: those of the static
    model come first."""

    logits: Tensor  # (M0,) opacities of those that the static model has, from now on
    added: tuple[Gaussians, ...]
    centers: Tensor  # (M,) in units of the clip
    spans: Tensor  # (M,)
    velocities: Tensor  # (M, 3) world units per clip


def initialize_free(
    static: Gaussians, timed_gaussians: Sequence[TimedGaussians], others: Gaussians, num_times: int
) -> FreeInitialization:
    """Return copies of the M ``still`` Gaussians that move, the Gaussians of ``moments``, and
    ``others``.

    Of the first there are so many that each is there for a part of the clip only; those of moments
    are there for about a gap between times, ``others`` for a quarter of the clip, somewhere.
    """
    copies = min(num_times, max(COPIES_OF_MOVING // max(len(static), 1), 1))
    faint = static.replace(
        logit_opacities=static.logit_opacities.clamp_max(FAINT if timed_gaussians else math.inf)
    )
    resting = torch.zeros(3, device="cpu")
    parts = [TimedGaussians((i + 0.5) / copies, faint, resting) for i in range(copies)]
    groups = [*parts, *timed_gaussians]
    sizes = torch.tensor([len(one.gaussians) for one in groups], device="cpu")
    centers = torch.tensor([one.time for one in groups], device="cpu")
    spans = torch.full_like(centers, FIRST_SPAN / max(num_times - 1, 1))
    spans[:copies] = 1 / copies
    velocities = torch.stack([one.velocity for one in groups]).repeat_interleave(sizes, dim=0)
    rest = torch.linspace(0, 1, len(others), device="cpu")
    return FreeInitialization(
        faint.logit_opacities,
        (*(one.gaussians for one in groups[1:]), others),
        torch.cat([centers.repeat_interleave(sizes), rest]),
        torch.cat([spans.repeat_interleave(sizes), torch.full_like(rest, OTHERS_SPAN)]),
        torch.cat([velocities, torch.zeros(len(others), 3, device="cpu")]),
    )
