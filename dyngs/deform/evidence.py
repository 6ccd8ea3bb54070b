"""Evidence that something moves, from images and from the errors of a small static model, before a scene is trained.

How far a static model errs says little: an unfinished one errs everywhere. *When* it errs says more: errors of what
stands depend on where an image was taken from, errors of what moves on when.

Local letters: V views in order of time, N Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

DIFFERS = 0.06
"""Difference from the median image, mean over channels, from which a pixel shows something else."""
MIN_DIFFERING = 1e-3
"""Fraction of differing pixels, over all images of cameras that stay in place, from which something moves."""
SHUFFLES = 40
"""Random orders of the views that show how errors agree by chance."""
MOVES_FROM, STILL_UP_TO = 4.0, 3.0
"""Agreement of errors, in standard deviations of chance, from which something moves, and up to which nothing does."""
COVERS = 1.0
"""Sum of blending weights, in pixels, from which a Gaussian is seen in a view."""
MIN_SEEN = 20
"""Views that see a Gaussian, below which its errors say nothing."""
DAMPING = 0.02
"""Ridge of the fit of errors over directions, as a fraction of the weights."""


class Verdict(Enum):
    """Answer of the images."""

    STILL = "still"
    MOVES = "moves"
    OPEN = "open"


@dataclass(frozen=True)
class Evidence:
    """Whether something moves.

    Attributes:
        verdict: of the images; open where time and viewpoint cannot be told apart.
        reason: for people: what was measured, and the figure.
    """

    verdict: Verdict
    reason: str


@dataclass(frozen=True)
class Agreement:
    """How far errors at times that follow each other agree.

    Attributes:
        correlation: their mean correlation.
        deviations: by how many standard deviations it lies above that of random orders of the views.
    """

    correlation: float
    deviations: float

    @property
    def verdict(self) -> Verdict:
        if self.deviations >= MOVES_FROM:
            return Verdict.MOVES
        return Verdict.STILL if self.deviations <= STILL_UP_TO else Verdict.OPEN


@torch.no_grad()
def differing_fraction(cameras: Sequence[Sequence[Tensor]]) -> float:
    """Return the fraction of pixels that differ from the median image of their camera.

    Each image is first brought to the brightness of the median (changing exposure is no motion) and averaged over
    2x2 pixels, against noise.

    Args:
        cameras: images (H, W, 3) in [0, 1] of each camera that stays in place.
    """
    differing = total = 0
    for images in cameras:
        smooth = [avg_pool2d(image.movedim(2, 0), 2, ceil_mode=True) for image in images]
        usual = torch.stack(smooth).median(0).values
        for image in smooth:
            gap = image - usual
            gap = gap - gap.flatten(1).median(1).values[:, None, None]
            differing += int((gap.abs().mean(0) > DIFFERS).sum())
            total += gap[0].numel()
    return differing / max(total, 1)


@torch.no_grad()
def agreement_over_time(errors: Tensor, weights: Tensor, directions: Tensor, generator: torch.Generator) -> Agreement:
    """Return how far errors at times that follow each other agree, where views look from all sides in no order.

    The error of a Gaussian in a view is the weighted mean over the pixels that show it. Its part that depends on the
    direction of view, as far as harmonics of degree 2 can tell, is left out. In a static scene views that follow each
    other in time have nothing in common, however little the model has learned.

    Args:
        errors: (V, N, 3) sums over pixels of blending weight times signed error, views in order of time.
        weights: (V, N) sums of blending weights.
        directions: (V, 3) unit viewing directions.
        generator: a CPU generator, for random orders.
    """
    seen = weights > COVERS
    enough = seen.sum(0) >= MIN_SEEN
    seen, weights = seen[:, enough], (weights * (weights > COVERS))[:, enough]
    mean = torch.where(seen[..., None], errors[:, enough] / weights.clamp_min(COVERS)[..., None], 0.0)
    stray = torch.where(seen[..., None], mean - _over_directions(mean, weights, directions), 0.0)

    def correlation(order: Tensor) -> float:
        before, after = order[:-1], order[1:]
        both = torch.minimum(weights[before], weights[after]).sqrt()
        product = (stray[before] * stray[after]).sum(2) * both
        size = (stray[before].square() + stray[after].square()).sum(2) * both
        return float(2 * product.sum() / size.sum().clamp_min(1e-12))

    count = len(errors)
    chance = torch.tensor(
        [correlation(torch.randperm(count, generator=generator, device="cpu")) for _ in range(SHUFFLES)], device="cpu"
    )
    found = correlation(torch.arange(count, device="cpu"))
    return Agreement(found, (found - float(chance.mean())) / max(float(chance.std()), 1e-6))


def _over_directions(mean: Tensor, weights: Tensor, directions: Tensor) -> Tensor:
    """Return the fit (V, N, 3) of ``mean`` by harmonics of degree 2 of the directions, for each Gaussian on its own."""
    x, y, z = directions.to(mean).T
    terms = torch.stack([torch.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], dim=1)
    normal = torch.einsum("vk,vn,vl->nkl", terms, weights, terms)
    ridge = DAMPING * weights.sum(0)[:, None, None] + 1e-3
    normal = normal + ridge * torch.eye(terms.shape[1], device=mean.device)
    right = torch.einsum("vk,vn,vnc->nkc", terms, weights, mean)
    return torch.einsum("vk,nkc->vnc", terms, torch.linalg.solve(normal, right))
