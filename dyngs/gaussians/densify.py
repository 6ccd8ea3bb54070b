"""Densification strategies: clone, split and prune by 2D gradients (3DGS, AbsGS), and 3DGS-MCMC.

``Densifier`` is the interface of all strategies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dyngs.config import DefaultStrategy, McmcStrategy
from dyngs.core.tensor_checks import require_tensor
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.ops.quaternions import rotate

# relative to the reference length: smaller Gaussians are cloned, larger split
DENSE_FRACTION = 0.01
# Relative to the reference length: larger Gaussians are pruned after the first opacity reset.
PRUNE_SCALE = 0.1
FAR = 5.0  # scene extents; the reference length of Gaussians beyond is their distance
SPLIT_SHRINK = 1.6
RESET_OPACITY = 0.01
MAX_LOG_VARIANCE = 60.0  # keeps random offsets finite for any scale


@dataclass(frozen=True)
class DensifySchedule:
    """Steps of densification, already scaled to the length of the run."""

    # Densification happens strictly between ``start`` and ``stop``.
    start: int
    stop: int
    every: int
    resets: tuple[int, ...] = ()
    prune_scale_after: int = 0  # too large Gaussians are pruned from this step on
    prunes_to_end: bool = False  # transparent Gaussians are also pruned after ``stop``

    def densifies_at(self, step: int) -> bool:
        return self.start < step < self.stop and step % self.every == 0

    def prunes_at(self, step: int) -> bool:
        """Return whether transparent Gaussians are pruned at ``step``, without densification."""
        return self.prunes_to_end and step >= self.stop and step % self.every == 0


class Densifier:
    """Interface of densification strategies; this base class changes nothing."""

    def needs_gradient(self, step: int) -> bool:
        """Return whether ``after_backward`` needs the gradient of the 2D means at ``step``."""
        return False

    def after_backward(
        self, step: int, probe_grad: Tensor, radii: Tensor, size: tuple[int, int]
    ) -> None:
        """Accumulate the probe's gradient (V, N, 4) and radii (V, N, 2) of images of ``size``
        (width, height)."""

    def add_time_gradient(self, step: int, gradient: Tensor | None) -> None:
        """Accumulate the loss gradient (N,) of a step by the mean times, in units of its
        threshold."""

    def tallies(self, step: int, count: int) -> list[Tensor]:
        """Return the sums of ``step`` over N = ``count`` Gaussians; processes all-reduce them in
        place."""
        return []

    def edit(
        self, step: int, parameters: Gaussians, generator: torch.Generator
    ) -> EditResult | None:
        """Return the edit after ``step``; None if nothing changes."""
        return None

    def regularizers(self, parameters: Gaussians) -> dict[str, Tensor]:
        """Return weighted regularisation terms of the loss by name."""
        return {}

    def perturb(self, parameters: Gaussians, lr_means: float, generator: torch.Generator) -> None:
        """Add the noise of the strategy to the parameters in place, after the optimiser step."""

    def move_to(self, device: torch.device) -> None:
        """Move the state to ``device``."""

    def limit(self, max_gaussians: int) -> None:
        """Set the maximum number of Gaussians from now on; existing ones stay. Not part of the
        state."""

    def state(self) -> dict[str, Tensor]:
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore a state that ``state()`` returned."""


class DefaultDensifier(Densifier):
    """Clone, split and prune by the mean 2D gradient norm over the views that see a Gaussian
    (3DGS).

    Small Gaussians with a large gradient are cloned, large ones split in two. Transparent and,
    after the first reset, too large ones are pruned. Opacities are reset at intervals. At least
    one Gaussian remains. If ``max_gaussians`` is reached, the largest gradients are served first.

    Sizes are relative to a reference length: the scene extent, or the distance from ``center``
    (3,), the mean camera position, for Gaussians beyond ``FAR`` extents. 3DGS uses the extent for
    all Gaussians and so prunes sky and distant hills.
    """

    def __init__(
        self, options: DefaultStrategy, schedule: DensifySchedule, extent: float, center: Tensor
    ) -> None:
        self.options, self.schedule, self.extent, self.center = options, schedule, extent, center
        # (2, N) sums of gradient norms and numbers of views: since the last edit, and of this
        # step.
        self.sums = torch.zeros(2, 0, device="cpu")
        self._step_sums = self.sums
        # (2, N) sums of time gradient magnitudes and numbers of steps, since the last edit
        self.time_sums = self.sums

    def needs_gradient(self, step: int) -> bool:
        return step < self.schedule.stop

    def after_backward(
        self, step: int, probe_grad: Tensor, radii: Tensor, size: tuple[int, int]
    ) -> None:
        if not self.needs_gradient(step):
            return
        self._reset_step(probe_grad.shape[1], probe_grad.device)
        grad = probe_grad[..., 2:] if self.options.absgrad else probe_grad[..., :2]
        x = grad[..., 0] * (0.5 * size[0])
        y = grad[..., 1] * (0.5 * size[1])
        length = torch.hypot(x, y)
        # views with a non-finite gradient are ignored
        counts = (radii > 0).all(-1) & length.isfinite()
        self._step_sums += torch.stack([torch.where(counts, length, 0.0).sum(0), counts.sum(0)])

    def add_time_gradient(self, step: int, gradient: Tensor | None) -> None:
        if gradient is None or not self.needs_gradient(step):
            return
        magnitude = gradient.abs()
        counts = (magnitude > 0) & magnitude.isfinite()
        added = torch.stack([torch.where(counts, magnitude, 0.0), counts.to(magnitude.dtype)])
        self.time_sums = _accumulated(self.time_sums, added)

    def tallies(self, step: int, count: int) -> list[Tensor]:
        if not self.needs_gradient(step):
            return []
        self._reset_step(count, self._step_sums.device)
        return [self._step_sums]

    def edit(
        self, step: int, parameters: Gaussians, generator: torch.Generator
    ) -> EditResult | None:
        self._accumulate_step()
        resets = step in self.schedule.resets
        parameters = parameters.detach()
        if self.schedule.densifies_at(step) and self.sums.shape[1] == len(parameters):
            result = self._densify(step, parameters, generator)
            self.sums = torch.zeros(2, 0, device="cpu")
            self.time_sums = self.sums
        elif self.schedule.prunes_at(step):
            kept = parameters.opacities >= self.options.prune_opacity
            is_due = bool(kept.any()) and not bool(kept.all())
            return EditResult(TopologyEdit.select(kept)) if is_due else None
        elif resets:
            result = EditResult(None)
        else:
            return None
        return with_opacity_reset(result, parameters.logit_opacities) if resets else result

    def move_to(self, device: torch.device) -> None:
        self.sums = self.sums.to(device)
        self.time_sums = self.time_sums.to(device)
        self.center = self.center.to(device)

    def limit(self, max_gaussians: int) -> None:
        self.options = self.options.model_copy(update={"max_gaussians": max_gaussians})

    def state(self) -> dict[str, Tensor]:
        self._accumulate_step()
        state = {"grad_sum": self.sums[0], "seen": self.sums[1]}
        if self.time_sums.shape[1]:
            state |= {"time_grad_sum": self.time_sums[0], "time_seen": self.time_sums[1]}
        return state

    def load_state(self, state: dict[str, Tensor]) -> None:
        self.sums = _stored_sums(state, "grad_sum", "seen")
        self.time_sums = _stored_sums(state, "time_grad_sum", "time_seen")
        self._step_sums = self.sums[:, :0]

    def _reset_step(self, count: int, device: torch.device) -> None:
        if self._step_sums.shape[1] != count:
            self._step_sums = torch.zeros(2, count, device=device)

    def _accumulate_step(self) -> None:
        """Accumulate the 2D gradient norms of this step."""
        if self._step_sums.shape[1]:
            self.sums = _accumulated(self.sums, self._step_sums)
            self._step_sums = self._step_sums[:, :0]

    def _densify(self, step: int, parameters: Gaussians, generator: torch.Generator) -> EditResult:
        distance = (parameters.means - self.center).norm(dim=1)
        reference_length = torch.where(distance > FAR * self.extent, distance, self.extent)
        max_scale = (
            PRUNE_SCALE * reference_length if step > self.schedule.prune_scale_after else math.inf
        )
        score = self.sums[0] / self.sums[1].clamp_min(1)
        if self.time_sums.shape == self.sums.shape:
            time_score = self.time_sums[0] / self.time_sums[1].clamp_min(1)
            score = torch.maximum(score, self.options.grad_threshold * time_score)
        plan = plan_edit(parameters, score, self.options, reference_length, max_scale)
        return apply_plan(parameters, plan, generator)


def _accumulated(sums: Tensor, added: Tensor) -> Tensor:
    """Return ``sums`` plus ``added`` (2, N); without ``sums`` of another number of Gaussians."""
    return sums + added if sums.shape == added.shape else added


def _stored_sums(state: dict[str, Tensor], *names: str) -> Tensor:
    """Return the sums with these ``names`` (2, N) in a state; empty if the run was edited after
    its end."""
    count = len(state.get(names[1], ()))
    if not count:
        return torch.zeros(2, 0, device="cpu")
    return torch.stack([require_tensor(name, state[name], (count,)) for name in names])


class EditPlan(NamedTuple):
    """Masks (N,) bool of the Gaussians that are kept, cloned and split.

    A cloned Gaussian is also kept, a split one is not. Gaussians in no mask are pruned.
    """

    kept: Tensor
    cloned: Tensor
    split: Tensor


def plan_edit(
    parameters: Gaussians,
    score: Tensor,
    options: DefaultStrategy,
    reference_length: float | Tensor,
    max_scale: float | Tensor,
) -> EditPlan:
    """Plan one densification step.

    Args:
        score: (N,) mean 2D gradient norm.
        reference_length: (N,) or one for all, world units, see ``DefaultDensifier``.
        max_scale: (N,) or one for all, world units; larger Gaussians are pruned.
    """
    scale = parameters.log_scales.amax(1).exp()
    opaque = parameters.opacities >= options.prune_opacity
    if len(scale) <= options.prune_above:
        opaque = torch.ones_like(opaque)
        max_scale = math.inf
    survives = opaque & (scale <= max_scale)
    wanted = opaque & (score >= options.grad_threshold) & options.grow
    large = scale > DENSE_FRACTION * reference_length
    split = wanted & large & (scale / SPLIT_SHRINK <= max_scale)
    cloned = wanted & ~large & survives
    # A candidate adds one Gaussian. Splitting one that would otherwise be pruned adds two.
    cost = torch.where(split & ~survives, 2, 1)
    chosen = _select_within_budget(
        split | cloned, score, cost, options.max_gaussians - int(survives.sum())
    )
    split = split & chosen
    cloned = cloned & chosen
    kept = survives & ~split
    if not bool((kept | split).any()):
        kept[parameters.logit_opacities.nan_to_num(nan=-math.inf).argmax()] = True
    return EditPlan(kept, cloned, split)


def apply_plan(parameters: Gaussians, plan: EditPlan, generator: torch.Generator) -> EditResult:
    """Clone and split as planned; the halves of a split Gaussian are sampled from it."""
    kept, cloned, split = (torch.nonzero(mask)[:, 0] for mask in plan)
    source = torch.cat([kept, cloned, split, split])
    is_new = torch.ones(len(source), dtype=torch.bool, device=source.device)
    is_new[: len(kept)] = False
    means = parameters.means[source]
    log_scales = parameters.log_scales[source]
    children = slice(len(kept) + len(cloned), None)
    sizes = log_scales[children].clamp_max(MAX_LOG_VARIANCE / 2).exp()
    noise = (
        torch.randn((2 * len(split), 3), generator=generator, device="cpu").to(sizes.device) * sizes
    )
    means[children] += rotate(parameters.quats[source[children]], noise)
    log_scales[children] -= math.log(SPLIT_SHRINK)
    return EditResult(TopologyEdit(source, is_new), {"means": means, "log_scales": log_scales})


def _select_within_budget(candidates: Tensor, score: Tensor, cost: Tensor, room: int) -> Tensor:
    """Select the candidates of highest score whose total cost is at most ``room``; ties by index.

    Returns (N,) bool.
    """
    indices = torch.nonzero(candidates)[:, 0]
    if int(cost[indices].sum()) <= room:
        return candidates
    indices = indices[torch.sort(score[indices], descending=True, stable=True).indices]
    chosen = torch.zeros_like(candidates)
    chosen[indices[torch.cumsum(cost[indices], 0) <= room]] = True
    return chosen


def with_opacity_reset(
    result: EditResult, logit_opacities: Tensor, most: float = RESET_OPACITY
) -> EditResult:
    """Add an opacity reset to an edit: opacities of at most ``most`` and zero moments."""
    moved = logit_opacities if result.edit is None else result.edit.apply(logit_opacities)
    lowered = moved.clamp_max(math.log(most / (1 - most)))
    changes = {**result.changes, "logit_opacities": lowered}
    return EditResult(result.edit, changes, result.zero_moments | {"logit_opacities"})


MAX_COPIES = 50
NOISE_STEEPNESS = 100.0
NOISE_OPACITY = 0.005
NOISE_MAX_OPACITY = 0.3
"""Above this opacity the published noise moves a Gaussian by less than 1e-12; no noise is drawn."""


class McmcDensifier(Densifier):
    """3DGS-MCMC: relocate dead Gaussians, grow up to a cap, add noise to nearly transparent ones.

    Relocation preserves the rendered image, so there is no gradient threshold, opacity reset or
    pruning.
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
            picks = _sample_indices(torch.where(alive, opacities, 0.0), len(dead), generator)
            opacities, log_scales, shared = self._split_into_copies(opacities, log_scales, picks)
            source[dead] = picks
            opacities[dead] = opacities[picks]
            log_scales[dead] = log_scales[picks]
            is_new = is_new | shared
        added = max(0, int(min(self.max_gaussians, (1 + self.growth) * n)) - n)
        if added > 0:
            picks = _sample_indices(opacities, added, generator)
            opacities, log_scales, shared = self._split_into_copies(opacities, log_scales, picks)
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
        """Add noise * lr * sigmoid(100 (0.005 - o)) * Sigma eta to the means; eta is standard
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
        # sigmoid would depend on the number of threads
        opacities = torch.nn.functional.logsigmoid(logits).exp()
        weight = 1 / (1 + (NOISE_STEEPNESS * (opacities - NOISE_OPACITY)).exp())
        parameters.means.detach().index_add_(
            0, rows, shake * (weight * (self.options.noise * lr_means))[:, None]
        )

    def limit(self, max_gaussians: int) -> None:
        self.max_gaussians = max_gaussians

    def _split_into_copies(
        self, opacities: Tensor, log_scales: Tensor, picks: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Split each picked row into several coincident copies.

        Returns opacities, log scales and a mask of the changed rows.
        """
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


def _sample_indices(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Sample ``count`` indices with ``weights`` (N,), with replacement; ``generator`` is on the
    CPU."""
    return torch.multinomial(weights.cpu(), count, replacement=True, generator=generator).to(
        weights.device
    )


def compute_relocation(
    opacities: Tensor, copies: Tensor, min_opacity: float = 0.005
) -> tuple[Tensor, Tensor]:
    """Compute opacities and scale factors of N coincident copies of a Gaussian of opacity o
    (3DGS-MCMC).

    o' = 1 - (1 - o)^(1/N). The scale factor preserves the integral of the composited 1D profile: o
    / sum_{j=1..N} C(N, j) (-1)^(j-1) o'^j / sqrt(j), the published double sum with its inner
    binomials summed.

    Args:
        min_opacity: lower bound of o'; where it applies, the integral is not preserved.

    Returns:
        o' (n,) and the factor (n,), float64.
    """
    from scipy.linalg import pascal

    eps = torch.finfo(torch.float32).eps
    opacities = opacities.double().clamp_max(1 - eps)
    copies = copies.clamp(1, MAX_COPIES)
    thinner = -torch.expm1(torch.log1p(-opacities) / copies)
    thinner = thinner.clamp(min_opacity, 1 - eps)
    j = torch.arange(1, MAX_COPIES + 1, dtype=torch.float64, device=opacities.device)
    binomials = torch.from_numpy(np.asarray(pascal(MAX_COPIES + 1, "lower"), np.float64))
    profile = (
        binomials.to(copies.device)[copies][:, 1:] * torch.where(j % 2 == 1, 1.0, -1.0) / j.sqrt()
    )
    powers = (thinner.log()[:, None] * j).exp()  # torch.pow would depend on the number of threads
    return thinner, opacities / (profile * powers).sum(1)
