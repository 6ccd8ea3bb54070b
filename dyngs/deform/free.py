"""Free primitives: each moving Gaussian has its own moment, span and velocity, and is not there before and after.

After FreeTimeGS (Wang et al. 2025), with windows that are added to the logit of the opacity, so that what is opaque is
equally so for most of its span. Nothing ties one time to another: what comes and goes, changes shape or travels by more
than its own size is learned from the views of its times alone, which should be several.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.config import FreeField
from dyngs.deform.field import DeformationField, FieldSetup, Offsets, chosen
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.parameters import Parameters
from dyngs.state import Role

SHORTEST = 0.25  # Least span, in gaps between times: less would flicker between them
LOWEST = -60.0  # Logarithm of a window where it is closed; an opacity of 0 in float32
SHIFT = 0.5  # Spans by which a new Gaussian is earlier or later than the one it descends from
LR_CENTERS, LR_SPANS, LR_VELOCITIES = 0.01, 0.01, 1e-4
"""Learning rates: in gaps between times, of the logarithm, in scene extents per gap."""
LR_DECAY = 0.1  # Ratio of the last to the first learning rate


class FreePrimitives(DeformationField):
    """x(t) = x + v (t - o) and logit(t) = logit - (t - c)^2 / (2 d^2) for each of M Gaussians.

    c is the centre of its window, d the span, v the velocity; o, where it is at its canonical place, is not learned: the
    window of a thing may shift without its path.
    """

    rows_rest = True

    def __init__(self, options: FreeField, setup: FieldSetup, generator: torch.Generator) -> None:
        self.options, self.setup = options, setup
        self.gap = 1 / max(setup.num_times - 1, 1)
        centers = torch.rand((setup.num_moving, 1), generator=generator, device="cpu")
        self.parameters = self._untrained(centers, torch.full_like(centers, 1.0), torch.zeros(len(centers), 3, device="cpu"))

    def started(self, centers: Tensor, spans: Tensor, velocities: Tensor) -> FreePrimitives:
        """Return an untrained field with windows around ``centers`` (M,) of ``spans`` (M,), in units of the clip.

        ``velocities`` (M, 3): world units per clip.
        """
        return self.with_parameters(self._untrained(centers[:, None], spans[:, None], velocities))

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        centers, origins, log_spans, velocities = (chosen(self.parameters[name], rows) for name in NAMES)
        shift = velocities * (time - origins.detach())
        spans = log_spans.exp() + SHORTEST * self.gap
        window = -0.5 * ((time - centers) / spans).square()
        return Offsets(shift, logit_opacities=window.clamp_min(LOWEST)[:, 0])

    def edited(self, edit: TopologyEdit) -> FreePrimitives:
        """Return the field after an edit; new rows are earlier and later in turn than those they descend from."""
        parameters = self.parameters.edited(Role.PER_MOVING, edit)
        new = torch.nonzero(edit.is_new)[:, 0]
        if len(new):
            ordered = new[edit.source[new].sort(stable=True).indices]  # two of one source get both signs
            signs = torch.ones(len(new), 1, device=new.device)
            signs[::2] = -1
            spans = parameters["log_spans"].data[ordered].exp() + SHORTEST * self.gap
            centers = parameters["centers"].data
            centers[ordered] = (centers[ordered] + SHIFT * spans * signs).clamp(0, 1)
        return self.with_parameters(parameters)

    def _untrained(self, centers: Tensor, spans: Tensor, velocities: Tensor) -> Parameters:
        log_spans = (spans - SHORTEST * self.gap).clamp_min(1e-3 * self.gap).log()
        tensors = {"centers": centers, "origins": centers.clone(), "log_spans": log_spans, "velocities": velocities}
        rates = {
            "centers": LR_CENTERS * self.gap,
            "origins": 0.0,
            "log_spans": LR_SPANS,
            "velocities": LR_VELOCITIES * self.setup.extent / self.gap,
        }
        return Parameters(tensors, rates, LR_DECAY, Role.PER_MOVING)


NAMES = "centers", "origins", "log_spans", "velocities"


MOST_COPIES = 12_000  # Gaussians that copies of what a static model has may add up to


@dataclass(frozen=True)
class FreeStart:
    """Gaussians to add when motion begins, and windows of all M that move: the rows of the static model come first."""

    added: tuple[Gaussians, ...]
    centers: Tensor  # (M,) in units of the clip
    spans: Tensor  # (M,)
    velocities: Tensor  # (M, 3) world units per clip


def copied_over_time(still: Gaussians, num_times: int) -> FreeStart:
    """Return copies of M Gaussians, so many that each is there for a part of the clip only."""
    count = min(num_times, max(MOST_COPIES // max(len(still), 1), 1))
    centers = (torch.arange(count, device="cpu") + 0.5) / count
    return FreeStart(
        (still,) * (count - 1),
        centers.repeat_interleave(len(still)),
        torch.full((count * len(still),), 1 / count, device="cpu"),
        torch.zeros(count * len(still), 3, device="cpu"),
    )
