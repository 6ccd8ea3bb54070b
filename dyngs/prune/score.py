"""Importance of each Gaussian: its fraction of images over views and times, weighted in one of several ways.

Local letters: K moments, C (K, N) sums over pixels and views of what a Gaussian contributes at each moment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.gaussians.rendering import RenderOptions, contributions, sensitivities
from dyngs.gaussians.scene import GaussianScene

STEEPNESS = 4.0  # Slope of the hyperbolic tangent: second differences of a profile are small numbers
VOLUME_POWER = 0.1


@dataclass(frozen=True)
class ScoringViews:
    """A scene, and the views that its Gaussians are scored on: every camera at every time."""

    scene: GaussianScene
    cameras: Sequence[Cameras]
    times: Sequence[float | None]
    options: RenderOptions
    background: Tensor


@dataclass(frozen=True)
class Importance:
    """Contributions of N Gaussians at K moments."""

    fractions: Tensor
    slopes: Tensor | None
    opacities: Tensor
    log_volumes: Tensor

    @property
    def contribution(self) -> Tensor:
        return self.fractions.sum(0)

    @property
    def temporal(self) -> Tensor:
        return (self._volumes() * self._variation()).sum(0)

    @property
    def variation(self) -> Tensor:
        """(N,) sum_k gamma(k) g(k) C(k), the spatio-temporal variation score of 4DGS-1K (Yuan et al. 2025) for a
        canonical form that moves.

        gamma(k) = V(k)^0.1 with the volume V, over that of the mean Gaussian; g(k) = 1 / (tanh(4 |d(k)|) / 2 + 1/2) in
        (1, 2] with the second difference d of the profile p over moments. p is the opacity over its maximum where it
        changes, and otherwise what is seen, C, smoothed by [1 2 1] / 4, over its maximum.
        """
        return (self._volumes() * self._variation() * self.fractions).sum(0)

    def _volumes(self) -> Tensor:
        return (VOLUME_POWER * (self.log_volumes - self.log_volumes.mean())).exp()

    def _variation(self) -> Tensor:
        fades = bool((self.opacities != self.opacities[:1]).any())
        profile = self.opacities if fades else _smoothed(self.fractions)
        profile = profile / profile.amax(0).clamp_min(torch.finfo(profile.dtype).tiny)
        padded = torch.cat([profile[:1], profile, profile[-1:]])
        bend = padded[2:] - 2 * profile + padded[:-2]
        return 1 / (0.5 * torch.tanh(STEEPNESS * bend.abs()) + 0.5)


@torch.no_grad()
def importance(views: ScoringViews, *, slopes: bool) -> Importance:
    """Return the contribution of each Gaussian to the images of ``views``; ``slopes`` cost the larger half."""
    scene, options, behind = views.scene, views.options, views.background
    fractions, opacities, volumes, squares = [], [], [], torch.zeros((), device=behind.device)
    for time in views.times:
        moment = scene.time_step(time)
        now = moment.gaussians
        sums = [contributions(now, camera, options)[0] for camera in views.cameras]
        fractions.append(torch.stack(sums).sum(0))
        opacities.append(now.opacities)
        volumes.append(now.log_scales.sum(1))
        if slopes:
            shader = scene.shader(moment)
            for camera in views.cameras:
                squares = squares + sensitivities(now, camera, options, background=behind, shader=shader)[0]
    return Importance(torch.stack(fractions), squares if slopes else None, torch.stack(opacities), torch.stack(volumes))


def highest(scores: Tensor, fraction: float) -> Tensor:
    """Return (N,) bool: all but the lowest ``fraction`` of ``scores`` (N,), at least one; of equal ones the first."""
    count = min(max(1, math.ceil(len(scores) * (1 - fraction) - 1e-9)), len(scores))
    kept = torch.zeros(len(scores), dtype=torch.bool, device=scores.device)
    kept[torch.sort(scores, descending=True, stable=True).indices[:count]] = True
    return kept


def _smoothed(x: Tensor) -> Tensor:
    """Return (K, N) by [1 2 1] / 4 over K, ends repeated."""
    padded = torch.cat([x[:1], x, x[-1:]])
    return (padded[:-2] + 2 * x + padded[2:]) / 4
