"""Adding and removing Gaussians: clone, split and prune by the gradient of the 2D means (3DGS,
AbsGS).

``Densifier`` is what a model asks of any strategy; the other one is in ``mcmc.py``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dyngs.config import DefaultStrategy, McmcStrategy
from dyngs.core.tensor_checks import require_tensor
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.ops.quaternions import rotate

DENSE_FRACTION = 0.01  # Scale, in reaches, up to which Gaussians are cloned; larger ones are split
# Scale, in reaches, from which Gaussians are removed after the first opacity reset
PRUNE_SCALE = 0.1
FAR = 5.0  # Distance, in scene extents, from which a Gaussian is far
SPLIT_SHRINK = 1.6
RESET_OPACITY = 0.01
MAX_LOG_VARIANCE = 60.0  # Random offsets stay finite whatever the scales


@dataclass(frozen=True)
class DensifySchedule:
    """The steps at which the set of Gaussians changes, in steps of this run (already scaled with
    its length)."""

    # start, stop: changes happen strictly between the two
    start: int
    stop: int
    every: int
    resets: tuple[int, ...] = ()
    prune_scale_after: int = 0  # from this step on, Gaussians that are too large are removed

    def densifies_at(self, step: int) -> bool:
        return self.start < step < self.stop and step % self.every == 0


class Densifier:
    """A strategy that changes the set of Gaussians during training; this one leaves it as it is."""

    def needs_gradient(self, step: int) -> bool:
        """Return whether ``after_backward`` needs the gradient of the 2D means at ``step``."""
        return False

    def after_backward(
        self, step: int, probe_grad: Tensor, radii: Tensor, size: tuple[int, int]
    ) -> None:
        """Take in the probe's gradient (V, N, 4) and radii (V, N, 2) of images of ``size`` (width,
        height)."""

    def tallies(self, step: int, count: int) -> list[Tensor]:
        """Return what ``step`` has taken in of N = ``count`` Gaussians; processes that share it sum
        it in place."""
        return []

    def edit(
        self, step: int, parameters: Gaussians, generator: torch.Generator
    ) -> EditResult | None:
        """Return the edit after ``step``; None if nothing changes."""
        return None

    def regularizers(self, parameters: Gaussians) -> dict[str, Tensor]:
        """Return differentiable scalars, already weighted, that are added to the loss, by name."""
        return {}

    def perturb(self, parameters: Gaussians, lr_means: float, generator: torch.Generator) -> None:
        """Add the strategy's noise to the parameters, in place, after the optimizer's step."""

    def place(self, device: torch.device) -> None:
        """Go on on ``device``."""

    def limit(self, max_gaussians: int) -> None:
        """Limit the number of Gaussians from now on; none are removed. Not part of the state."""

    def state(self) -> dict[str, Tensor]:
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore the state that ``state()`` returned."""


class DefaultDensifier(Densifier):
    """Clone, split and prune by the mean norm of the 2D mean's gradient over the views that saw a
    Gaussian (3DGS).

    Small Gaussians with a large gradient are copied, large ones replaced by two samples of
    themselves, transparent and (later) huge ones removed; opacities are lowered now and then. At
    least one Gaussian is always left. Where the cap ``max_gaussians`` leaves no room for all, those
    with the largest gradients go first.

    What is large is judged by the reach of a Gaussian: the scene extent, or of what is ``FAR`` its
    distance from ``center`` (3,), the mean of the cameras. 3DGS takes the extent for all, and so
    removes sky and far hills, which need Gaussians as large as they are far.
    """

    def __init__(
        self, options: DefaultStrategy, schedule: DensifySchedule, extent: float, center: Tensor
    ) -> None:
        self.options, self.schedule, self.extent, self.center = options, schedule, extent, center
        # (2, N) sums of the gradient norms, and numbers of views: of the steps since the last edit,
        # and of this step
        self.sums = torch.zeros(2, 0, device="cpu")
        self._step_sums = self.sums

    def needs_gradient(self, step: int) -> bool:
        return step < self.schedule.stop

    def after_backward(
        self, step: int, probe_grad: Tensor, radii: Tensor, size: tuple[int, int]
    ) -> None:
        if not self.needs_gradient(step):
            return
        self._begin_step(probe_grad.shape[1], probe_grad.device)
        grad = probe_grad[..., 2:] if self.options.absgrad else probe_grad[..., :2]
        x = grad[..., 0] * (0.5 * size[0])
        y = grad[..., 1] * (0.5 * size[1])
        length = torch.hypot(x, y)
        # a view without a usable gradient says nothing
        counts = (radii > 0).all(-1) & length.isfinite()
        self._step_sums += torch.stack([torch.where(counts, length, 0.0).sum(0), counts.sum(0)])

    def tallies(self, step: int, count: int) -> list[Tensor]:
        if not self.needs_gradient(step):
            return []
        self._begin_step(count, self._step_sums.device)
        return [self._step_sums]

    def edit(
        self, step: int, parameters: Gaussians, generator: torch.Generator
    ) -> EditResult | None:
        self._take_in_step()
        resets = step in self.schedule.resets
        parameters = parameters.detach()
        if self.schedule.densifies_at(step) and self.sums.shape[1] == len(parameters):
            result = self._densify(step, parameters, generator)
            self.sums = torch.zeros(2, 0, device="cpu")
        elif resets:
            result = EditResult(None)
        else:
            return None
        return _with_lowered_opacities(result, parameters.logit_opacities) if resets else result

    def place(self, device: torch.device) -> None:
        self.sums = self.sums.to(device)
        self.center = self.center.to(device)

    def limit(self, max_gaussians: int) -> None:
        self.options = self.options.model_copy(update={"max_gaussians": max_gaussians})

    def state(self) -> dict[str, Tensor]:
        self._take_in_step()
        return {"grad_sum": self.sums[0], "seen": self.sums[1]}

    def load_state(self, state: dict[str, Tensor]) -> None:
        count = len(state.get("seen", ()))  # none of a run that was edited after its end
        names = ("grad_sum", "seen") if count else ()
        found = [require_tensor(name, state[name], (count,)) for name in names]
        self.sums = torch.stack(found) if found else self.sums[:, :0]
        self._step_sums = self.sums[:, :0]

    def _begin_step(self, count: int, device: torch.device) -> None:
        if self._step_sums.shape[1] != count:
            self._step_sums = torch.zeros(2, count, device=device)

    def _take_in_step(self) -> None:
        """Add what the views of a step have said to what those before it have."""
        if not self._step_sums.shape[1]:
            return
        same = self.sums.shape == self._step_sums.shape
        self.sums = self.sums + self._step_sums if same else self._step_sums
        self._step_sums = self._step_sums[:, :0]

    def _densify(self, step: int, parameters: Gaussians, generator: torch.Generator) -> EditResult:
        distance = (parameters.means - self.center).norm(dim=1)
        reach = torch.where(distance > FAR * self.extent, distance, self.extent)
        max_scale = PRUNE_SCALE * reach if step > self.schedule.prune_scale_after else math.inf
        score = self.sums[0] / self.sums[1].clamp_min(1)
        masks = plan_edit(parameters, score, self.options, reach, max_scale)
        kept, cloned, split = (torch.nonzero(mask)[:, 0] for mask in masks)
        source = torch.cat([kept, cloned, split, split])
        is_new = torch.ones(len(source), dtype=torch.bool, device=source.device)
        is_new[: len(kept)] = False
        means = parameters.means[source]
        log_scales = parameters.log_scales[source]
        children = slice(len(kept) + len(cloned), None)
        sizes = log_scales[children].clamp_max(MAX_LOG_VARIANCE / 2).exp()
        noise = (
            torch.randn((2 * len(split), 3), generator=generator, device="cpu").to(sizes.device)
            * sizes
        )
        means[children] += rotate(parameters.quats[source[children]], noise)
        log_scales[children] -= math.log(SPLIT_SHRINK)
        return EditResult(TopologyEdit(source, is_new), {"means": means, "log_scales": log_scales})


class EditPlan(NamedTuple):
    """Masks (N,) bool of the old Gaussians that stay as they are, are copied, and are split in two.

    A copied Gaussian is also kept, a split one is not; those in none of the three are removed.
    """

    kept: Tensor
    cloned: Tensor
    split: Tensor


def plan_edit(
    parameters: Gaussians,
    score: Tensor,
    options: DefaultStrategy,
    reach: float | Tensor,
    max_scale: float | Tensor,
) -> EditPlan:
    """Return the plan of one densification.

    Args:
        reach: (N,) or of all, world units, see ``DefaultDensifier``.
        max_scale: (N,) or of all, world units; larger Gaussians are removed.
    """
    scale = parameters.log_scales.amax(1).exp()
    opaque = parameters.opacities >= options.prune_opacity
    survives = opaque & (scale <= max_scale)
    wanted = opaque & (score >= options.grad_threshold)
    large = scale > DENSE_FRACTION * reach
    wanted = wanted if options.grow else torch.zeros_like(wanted)
    split = wanted & large & (scale / SPLIT_SHRINK <= max_scale)
    cloned = wanted & ~large & survives
    # A candidate adds one Gaussian; a split one that would otherwise have been removed adds two.
    cost = torch.where(split & ~survives, 2, 1)
    chosen = _best_within(split | cloned, score, cost, options.max_gaussians - int(survives.sum()))
    split = split & chosen
    cloned = cloned & chosen
    kept = survives & ~split
    if not bool((kept | split).any()):
        kept[parameters.logit_opacities.nan_to_num(nan=-math.inf).argmax()] = True
    return EditPlan(kept, cloned, split)


def _best_within(candidates: Tensor, score: Tensor, cost: Tensor, room: int) -> Tensor:
    """Return (N,) bool: the candidates of highest score whose costs add up to at most ``room``;
    ties by index."""
    indices = torch.nonzero(candidates)[:, 0]
    if int(cost[indices].sum()) <= room:
        return candidates
    indices = indices[torch.sort(score[indices], descending=True, stable=True).indices]
    chosen = torch.zeros_like(candidates)
    chosen[indices[torch.cumsum(cost[indices], 0) <= room]] = True
    return chosen


def _with_lowered_opacities(result: EditResult, logit_opacities: Tensor) -> EditResult:
    """Return ``result`` followed by an opacity reset: at most 0.01 everywhere, its moments at
    zero."""
    moved = logit_opacities if result.edit is None else result.edit.apply(logit_opacities)
    lowered = moved.clamp_max(math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    changes = {**result.changes, "logit_opacities": lowered}
    return EditResult(result.edit, changes, result.zero_moments | {"logit_opacities"})


MAX_COPIES = 50
NOISE_STEEPNESS = 100.0
NOISE_OPACITY = 0.005
NOISE_MAX_OPACITY = 0.3
"""More opaque Gaussians would move by less than 1e-12 of the published noise; nothing is drawn for
them."""


class McmcDensifier(Densifier):
    """Moves dead Gaussians onto living ones, grows the set up to a cap, and shakes the nearly
    transparent ones.

    Relocation keeps the composited appearance, so there is no threshold on gradients, no opacity
    reset, no pruning.
    """

    def __init__(self, options: McmcStrategy, schedule: DensifySchedule, growth: float) -> None:
        self.options, self.schedule, self.growth = options, schedule, growth
        self.max_gaussians = options.max_gaussians

    def edit(
        self, step: int, parameters: Gaussians, generator: torch.Generator
    ) -> EditResult | None:
        if not self.schedule.densifies_at(step):
            return None
        parameters = parameters.detach()
        opacities = parameters.opacities.double()
        log_scales = parameters.log_scales
        alive = opacities > self.options.prune_opacity
        if not bool(alive.any()):
            return None
        n = len(opacities)
        dead = torch.nonzero(~alive)[:, 0]
        source = torch.arange(n, device=opacities.device)
        is_new = ~alive
        if len(dead) > 0:
            picks = _drawn(torch.where(alive, opacities, 0.0), len(dead), generator)
            opacities, log_scales, shared = self._fraction(opacities, log_scales, picks)
            source[dead] = picks
            opacities[dead] = opacities[picks]
            log_scales[dead] = log_scales[picks]
            is_new = is_new | shared
        added = max(0, int(min(self.max_gaussians, (1 + self.growth) * n)) - n)
        if added > 0:
            picks = _drawn(opacities, added, generator)
            opacities, log_scales, shared = self._fraction(opacities, log_scales, picks)
            is_new = torch.cat(
                [is_new | shared, torch.ones(added, dtype=torch.bool, device=opacities.device)]
            )
            source = torch.cat([source, source[picks]])
            opacities = torch.cat([opacities, opacities[picks]])
            log_scales = torch.cat([log_scales, log_scales[picks]])
        logits = torch.where(
            is_new,
            (opacities.log() - torch.log1p(-opacities)).float(),
            parameters.logit_opacities[source],
        )
        return EditResult(
            TopologyEdit(source, is_new), {"logit_opacities": logits, "log_scales": log_scales}
        )

    def regularizers(self, parameters: Gaussians) -> dict[str, Tensor]:
        return {
            "opacity": self.options.opacity_reg * parameters.opacities.mean(),
            "scale": self.options.scale_reg * parameters.scales.mean(),
        }

    def perturb(self, parameters: Gaussians, lr_means: float, generator: torch.Generator) -> None:
        """Add noise * lr * sigmoid(100 (0.005 - o)) * Sigma eta to the means, with eta standard
        normal."""
        if self.options.noise == 0:
            return
        drawn = parameters.logit_opacities.detach() < math.log(
            NOISE_MAX_OPACITY / (1 - NOISE_MAX_OPACITY)
        )
        rows = torch.nonzero(drawn)[:, 0]
        quats, log_scales, logits = (
            x.detach()[rows]
            for x in (parameters.quats, parameters.log_scales, parameters.logit_opacities)
        )
        eta = torch.randn((len(rows), 3), generator=generator, device="cpu").to(quats.device)
        variances = (2 * log_scales).clamp_max(MAX_LOG_VARIANCE).exp()
        inverse = quats * torch.tensor([1.0, -1.0, -1.0, -1.0], device=quats.device)
        shake = rotate(quats, rotate(inverse, eta) * variances)
        # unlike sigmoid, the same on any number of threads
        opacities = torch.nn.functional.logsigmoid(logits).exp()
        weight = 1 / (1 + (NOISE_STEEPNESS * (opacities - NOISE_OPACITY)).exp())
        parameters.means.detach().index_add_(
            0, rows, shake * (weight * (self.options.noise * lr_means))[:, None]
        )

    def limit(self, max_gaussians: int) -> None:
        self.max_gaussians = max_gaussians

    def _fraction(
        self, opacities: Tensor, log_scales: Tensor, picks: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return opacities, log scales and a mask of changed rows after each picked row has become
        several copies."""
        copies = torch.bincount(picks, minlength=len(opacities)) + 1
        shared = copies > 1
        opacities = opacities.clone()
        log_scales = log_scales.clone()
        thinner, factor = compute_relocation(
            opacities[shared], copies[shared], self.options.prune_opacity
        )
        opacities[shared] = thinner
        log_scales[shared] += factor.log().float()[:, None]
        return opacities, log_scales, shared


def _drawn(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return ``count`` indices drawn with ``weights`` (N,), with repetition; the generator is one
    of the CPU."""
    return torch.multinomial(weights.cpu(), count, replacement=True, generator=generator).to(
        weights.device
    )


def compute_relocation(
    opacities: Tensor, copies: Tensor, min_opacity: float = 0.005
) -> tuple[Tensor, Tensor]:
    """Return the opacities and scale factors of N coincident copies that composite to one Gaussian
    of opacity o.

    o' = 1 - (1 - o)^(1/N); the scale factor keeps the integral of the composited 1-D profile:
    o / sum_{j=1..N} C(N, j) (-1)^(j-1) o'^j / sqrt(j), which is the published double sum with its
    inner binomials added up.

    Args:
        min_opacity: lower bound of o'; where it acts, the integral is not kept.

    Returns:
        o' (n,) and the factor (n,), float64.
    """
    eps = torch.finfo(torch.float32).eps
    opacities = opacities.double().clamp_max(1 - eps)
    copies = copies.clamp(1, MAX_COPIES)
    thinner = -torch.expm1(torch.log1p(-opacities) / copies)
    thinner = thinner.clamp(min_opacity, 1 - eps)
    j = torch.arange(1, MAX_COPIES + 1, dtype=torch.float64, device=opacities.device)
    profile = (
        _binomials().to(copies.device)[copies][:, 1:]
        * torch.where(j % 2 == 1, 1.0, -1.0)
        / j.sqrt()
    )
    powers = (thinner.log()[:, None] * j).exp()  # torch.pow depends on the number of threads
    return thinner, opacities / (profile * powers).sum(1)


def _binomials() -> Tensor:
    rows = [[float(math.comb(n, j)) for j in range(MAX_COPIES + 1)] for n in range(MAX_COPIES + 1)]
    return torch.tensor(rows, dtype=torch.float64, device="cpu")
