"""Evidence of motion: known answers on made-up errors and images."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from dyngs.deform.evidence import Verdict, agreement_over_time, differing_fraction

VIEWS, GAUSSIANS = 60, 40


def directions(generator: torch.Generator) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(VIEWS, 3, generator=generator), dim=1)


def verdict_of(errors: Tensor, looks: Tensor, weights: Tensor | None = None) -> Verdict:
    weights = torch.full(errors.shape[:2], 5.0) if weights is None else weights
    found = agreement_over_time(errors * weights[..., None], weights, looks, torch.Generator().manual_seed(1))
    return found.verdict


@pytest.mark.parametrize("seed", range(5))
def test_errors_that_depend_on_the_viewpoint_are_no_motion(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    looks = directions(generator)
    by_side = 0.2 * torch.einsum("vk,nkc->vnc", looks, torch.randn(GAUSSIANS, 3, 3, generator=generator))
    noise = 0.2 * torch.randn(VIEWS, GAUSSIANS, 3, generator=generator)
    assert verdict_of(by_side + noise, looks) is not Verdict.MOVES


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("fraction", [0.1, 1.0])
def test_errors_that_depend_on_time_are_motion(seed: int, fraction: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    phases = torch.rand(GAUSSIANS, 3, generator=generator) * 2 * math.pi
    times = torch.linspace(0, 4 * math.pi, VIEWS)[:, None, None]
    moves = (torch.arange(GAUSSIANS) < fraction * GAUSSIANS)[:, None]
    noise = 0.05 * torch.randn(VIEWS, GAUSSIANS, 3, generator=generator)
    assert verdict_of(0.2 * moves * torch.sin(times + phases) + noise, directions(generator)) is Verdict.MOVES


def test_views_that_see_nothing_say_nothing() -> None:
    generator = torch.Generator().manual_seed(0)
    looks, errors = directions(generator), torch.randn(VIEWS, GAUSSIANS, 3, generator=generator)
    assert verdict_of(errors, looks, torch.zeros(VIEWS, GAUSSIANS)) is Verdict.STILL


def test_a_ball_that_passes_differs_from_the_median() -> None:
    images = [torch.full((20, 20, 3), 0.5) for _ in range(5)]
    images[2][4:8, 6:10] = 1.0
    assert differing_fraction([images]) == pytest.approx(16 / 2000)


def test_exposure_and_noise_do_not_differ_from_the_median() -> None:
    generator = torch.Generator().manual_seed(0)
    base = torch.rand(20, 20, 3, generator=generator) * 0.5
    images = [base + 0.05 * i + 0.01 * torch.randn(20, 20, 3, generator=generator) for i in range(5)]
    assert differing_fraction([images]) == 0
