"""3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024): a cap, relocation of dead Gaussians,
noise."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dyngs.config import McmcStrategy
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.densify import MAX_LOG_VARIANCE, Densifier, DensifySchedule
from dyngs.ops.quaternions import rotate

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

    touches_all = True

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
        alive = opacities > self.options.min_opacity
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
        thinner, factor = relocated(opacities[shared], copies[shared], self.options.min_opacity)
        opacities[shared] = thinner
        log_scales[shared] += factor.log().float()[:, None]
        return opacities, log_scales, shared


def _drawn(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return ``count`` indices drawn with ``weights`` (N,), with repetition; the generator is one
    of the CPU."""
    return torch.multinomial(weights.cpu(), count, replacement=True, generator=generator).to(
        weights.device
    )


def relocated(
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
