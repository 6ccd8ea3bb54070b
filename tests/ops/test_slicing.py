"""4D Gaussians at a time compared with the Schur complement in float64, and their gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dyngs.ops.quaternions import rotation_matrices
from dyngs.ops.slicing import condition_gaussians, slice_gaussians


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_case(count: int) -> list[Tensor]:
    """Leaf arguments of ``slice_gaussians``."""
    shapes = (3,), (), (4,), (4,), (3,), (), ()
    return [normal(count, *x, seed=i).requires_grad_() for i, x in enumerate(shapes)]


def covariances(quats: Tensor, log_scales: Tensor) -> Tensor:
    half = rotation_matrices(quats) * log_scales.exp()[:, None, :]
    return half @ half.mT


def hamilton(a: Tensor, b: Tensor) -> Tensor:
    """The product of quaternions (..., 4) wxyz."""
    scalar = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdim=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:]
    first, second = torch.broadcast_tensors(a[..., 1:], b[..., 1:])
    return torch.cat([scalar, vector + torch.linalg.cross(first, second)], -1)


def reference_slice_gaussians(
    means: Tensor,
    times: Tensor,
    quats: Tensor,
    right_quats: Tensor,
    log_scales: Tensor,
    log_spans: Tensor,
    logit_opacities: Tensor,
    time: float,
) -> list[Tensor]:
    """Means, covariances and opacity logits in plain torch."""
    left, right = (torch.nn.functional.normalize(q, dim=1) for q in (quats, right_quats))
    axes = hamilton(hamilton(left[:, None], torch.eye(4).to(left)), right[:, None]).mT
    half = axes * torch.cat([log_spans[:, None], log_scales], 1).exp()[:, None]
    joint = half @ half.mT
    variance = joint[:, 0, 0]
    velocities = joint[:, 1:, 0] / variance[:, None]
    delay = time - times
    moved = means + velocities * delay[:, None]
    shapes = joint[:, 1:, 1:] - velocities[:, :, None] * joint[:, :1, 1:]
    opacities = logit_opacities.sigmoid() * (-delay.square() / (2 * variance)).exp()
    return [moved, shapes, opacities.logit()]


def sliced(*arguments: Tensor, time: float) -> list[Tensor]:
    """``reference_slice_gaussians`` computed by the op."""
    means, quats, log_scales, logits = slice_gaussians(*arguments, time=time, min_weight=0)
    return [means, covariances(quats, log_scales), logits]


def results(function, case: list[Tensor], time: float) -> list[Tensor]:
    """Outputs, and the gradients of all arguments for fixed output gradients."""
    outputs = function(*case, time=time)
    grads = [normal(*y.shape, seed=20 + i).to(y.dtype) for i, y in enumerate(outputs)]
    return [*(y.detach() for y in outputs), *torch.autograd.grad(outputs, case, grads)]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_slice_is_the_schur_complement(isa: str, dtype: torch.dtype) -> None:
    case = random_case(77)
    expected = results(reference_slice_gaussians, case, 0.3)
    found = results(sliced, [x.detach().to(dtype).requires_grad_() for x in case], 0.3)
    for a, b in zip(found, expected, strict=True):
        atol = float(b.abs().max()) * 100 * torch.finfo(dtype).eps
        torch.testing.assert_close(a.double(), b, rtol=0, atol=atol, msg=isa)


def test_the_shape_at_all_times_is_that_of_a_slice() -> None:
    case = [x.detach() for x in random_case(20)]
    quats, log_scales, velocities, log_stds = condition_gaussians(*case[2:6])
    now, later = (slice_gaussians(*case, time=time) for time in (0.25, 0.75))
    assert torch.equal(now[1], quats)
    assert torch.equal(now[2], log_scales)
    torch.testing.assert_close(later[0] - now[0], 0.5 * velocities)
    assert log_stds.shape == (20,)
