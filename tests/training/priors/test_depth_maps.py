from __future__ import annotations

import pytest
import torch

from dyngs.training.priors.depth_maps import DepthForm, aligned, depth_error, values_of


def true_depth() -> torch.Tensor:
    y, x = torch.meshgrid(torch.linspace(0, 1, 12), torch.linspace(0, 1, 16), indexing="ij")
    return 2 + x + 0.5 * y + (x > 0.5)


@pytest.mark.parametrize("kind", ["depth", "inverse"])
def test_scale_and_shift_do_not_count(kind: DepthForm) -> None:
    """A map that is affine in the true depth, or in its inverse, has no error."""
    depth = true_depth()
    given = 0.3 * depth + 0.2 if kind == "depth" else 1 / (0.5 / depth + 0.1)
    error = depth_error(depth, torch.ones_like(depth), given, kind)
    assert error is not None
    assert float(error) < 1e-5


def test_outliers_do_not_tilt_the_alignment() -> None:
    given = torch.linspace(1, 2, 100)
    wanted = 3 * given - 1
    spoiled = wanted.clone()
    spoiled[::8] = 50
    found = aligned(given, spoiled)
    assert found is not None
    torch.testing.assert_close(found, wanted, rtol=0, atol=0.05)
    assert aligned(given, -wanted) is None


def test_a_step_against_the_gradient_brings_a_wrong_depth_nearer() -> None:
    truth = true_depth()
    drawn = truth.clone()
    drawn[3:6, 3:6] += 0.5
    drawn.requires_grad_()
    error = depth_error(drawn, torch.ones_like(drawn), 0.3 * truth, "depth")
    assert error is not None
    (slope,) = torch.autograd.grad(error, drawn)
    assert bool((slope[3:6, 3:6] > 0).all())


def test_unknown_transparent_and_masked_pixels_do_not_count() -> None:
    depth, alpha, mask = true_depth(), torch.ones(12, 16), torch.ones(12, 16)
    given = depth.clone()
    given[0] = 0
    spoiled = depth.clone()
    spoiled[:3] = 90
    alpha[1], mask[2] = 0.2, 0
    error = depth_error(spoiled, alpha, given, "depth", mask)
    assert error is not None
    assert float(error) < 1e-5
    assert depth_error(depth, torch.zeros(12, 16), given, "depth") is None


def test_inverses_keep_unknown_pixels() -> None:
    assert values_of(torch.tensor([0.0, 2.0]), "inverse").tolist() == [0, 0.5]
