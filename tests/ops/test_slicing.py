"""4D Gaussians at a time compared with the Schur complement in float64, and their gradients."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.ops.quaternions import rotation_matrices
from dyngs.ops.slicing import condition_gaussians, harmonics_in_time, slice_gaussians

SHAPES = (3,), (), (4,), (4,), (3,), (), ()
COUNT = 40


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_case(count: int = COUNT) -> list[Tensor]:
    """Arguments of ``slice_gaussians`` that float32 holds exactly."""
    return [normal(count, *x, seed=i).float().double() for i, x in enumerate(SHAPES)]


def conjugate(quats: Tensor) -> Tensor:
    return quats * torch.tensor([1.0, -1, -1, -1]).to(quats)


def covariances(quats: Tensor, log_scales: Tensor) -> Tensor:
    half = rotation_matrices(quats) * log_scales.exp()[:, None, :]
    return half @ half.mT


def hamilton(a: Tensor, b: Tensor) -> Tensor:
    """The product of quaternions (..., 4) wxyz."""
    scalar = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdim=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:]
    first, second = torch.broadcast_tensors(a[..., 1:], b[..., 1:])
    return torch.cat([scalar, vector + torch.linalg.cross(first, second)], -1)


def roots(quats: Tensor, right_quats: Tensor, log_scales: Tensor, log_spans: Tensor) -> Tensor:
    """Roots (M, 4, 4) of the joint covariances of time (first) and space."""
    left, right = (torch.nn.functional.normalize(q, dim=1) for q in (quats, right_quats))
    axes = hamilton(hamilton(left[:, None], torch.eye(4).to(left)), right[:, None]).mT
    return axes * torch.cat([log_spans[:, None], log_scales], 1).exp()[:, None]


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
    half = roots(quats, right_quats, log_scales, log_spans)
    variance = half[:, 0].square().sum(1)
    velocities = (half[:, 1:] @ half[:, 0, :, None])[..., 0] / variance[:, None]
    at_time = half[:, 1:] - velocities[:, :, None] * half[:, :1]
    delay = time - times
    exponent = delay.square() / (2 * variance)
    logits = -exponent - (-torch.expm1(-exponent) + (-logit_opacities).exp()).log()
    return [means + velocities * delay[:, None], at_time @ at_time.mT, logits]


def sliced(*arguments: Tensor, time: float) -> list[Tensor]:
    """``reference_slice_gaussians`` computed by the op."""
    means, quats, log_scales, logits = slice_gaussians(*arguments, time=time, min_weight=0)
    return [means, covariances(quats, log_scales), logits]


def results(function, case: list[Tensor], sizes: Tensor) -> list[Tensor]:
    """Outputs at time 0, covariances relative to ``sizes``, and the gradients of all arguments."""
    case = [x.detach().requires_grad_() for x in case]
    means, shapes, logits = function(*case, time=0.0)
    outputs = [means, shapes / sizes.to(shapes)[:, None, None], logits]
    grads = [normal(*y.shape, seed=20 + i).to(y) for i, y in enumerate(outputs)]
    return [*(y.detach() for y in outputs), *torch.autograd.grad(outputs, case, grads)]


def assert_like_reference(
    case: list[Tensor], dtype: torch.dtype, tolerance: float, *, by_scales: bool = True
) -> None:
    """Assert closeness, relative to the largest number of each Gaussian.

    Without ``by_scales`` the gradients by scales are not compared.
    """
    sizes = reference_slice_gaussians(*case, time=0.0)[1].norm(dim=(1, 2))
    expected = results(reference_slice_gaussians, case, sizes)
    found = results(sliced, [x.to(dtype) for x in case], sizes)
    for numbers in (expected, found):
        numbers[7] = torch.cat([numbers[7], numbers.pop(8)[:, None]], 1)
    names = ["means", "covariances", "logits", "by means", "by times", "by left", "by right"]
    for name, a, b in zip([*names, "by scales", "by logits"], found, expected, strict=True):
        error = (a.double() - b).abs().view(len(b), -1).amax(1)
        scale = b.abs().view(len(b), -1).amax(1).clamp_min(1e-2)
        if by_scales or name != "by scales":
            assert float((error / scale).max()) < tolerance, name


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_slice_is_the_schur_complement(isa: str, dtype: torch.dtype) -> None:
    assert_like_reference(random_case(77), dtype, 1e-11 if dtype == torch.float64 else 1e-4)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-7), (torch.float32, 1e-4)])
@pytest.mark.parametrize("span", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(
    ("axes", "still"),
    [
        ((1e-2, 2e-2, 3e-2), False),
        ((1e-2, 2e-2, 3e-2), True),
        ((1e-4, 2e-8, 1e-8), False),
        ((1e-4, 2e-8, 1e-8), True),
        ((1e-2, 2e-2, 1e-6), False),
        ((1e-2, 2e-2, 1e-6), True),
        ((1e-2, 1e-2, 1e-2), False),
        ((1e4, 2e-2, 1e-2), False),
    ],
    ids=["blob", "still", "needle", "still needle", "disc", "still disc", "ball", "fast needle"],
)
def test_extremes_are_exact(
    axes: tuple[float, ...], still: bool, span: float, dtype: torch.dtype, tolerance: float
) -> None:
    """Spans are 1e-6 to 1e6 clips; times are within two standard deviations.

    Two axes of a moving ball are equal, where gradients by scales are not exact.
    """
    case = random_case()
    case[4] = torch.tensor(axes).log().double().expand(COUNT, 3).clone()
    if still:
        case[3] = conjugate(case[2])
    case[5] = torch.full((COUNT,), math.log(span)).double()
    deviations = roots(*case[2:6])[:, 0].norm(dim=1)
    case[1] = (case[1].clamp(-2, 2) * deviations).float().double()
    assert_like_reference(case, dtype, tolerance, by_scales=len(set(axes)) > 1)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("span", [-60.0, -13.8, 0.0, 13.8])
def test_a_still_gaussian_is_its_own_slice(span: float, dtype: torch.dtype) -> None:
    """Also one with a vanishing axis, equal axes, or a size of e^-60."""
    case = [x.to(dtype) for x in random_case()]
    case[3] = conjugate(case[2])
    case[4][:4, 1] = -60
    case[4][4:8] = case[4][4:8, :1]
    case[4][8:12] -= 60
    case[5][:] = span
    case[1][:] = 0.5
    means, quats, log_scales, logits = slice_gaussians(*case, time=0.5)
    near = {"rtol": 20 * torch.finfo(dtype).eps, "atol": 20 * torch.finfo(dtype).eps}
    torch.testing.assert_close(log_scales[4:], case[4][4:], **near)
    assert (log_scales[:4, 1] < log_scales[:4, 0] - 30).all()
    torch.testing.assert_close(rotation_matrices(quats), rotation_matrices(case[2]), **near)
    assert torch.equal(means, case[0])
    torch.testing.assert_close(logits, case[6], **near)
    velocities, log_stds = condition_gaussians(*case[2:6])[2:]
    if span >= -13.8:  # else the axes of space differ in time by more than that, by rounding
        assert float(velocities.abs().max()) < 1e-9
        torch.testing.assert_close(log_stds, case[5], **near)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_turn_from_x_to_time_has_a_known_slice(dtype: torch.dtype) -> None:
    turn = 0.4
    quats = torch.tensor([[math.cos(turn / 2), math.sin(turn / 2), 0, 0]], dtype=dtype)
    scales = torch.tensor([[0.3, 0.05, 0.2]], dtype=dtype)
    span = 0.7
    spans = torch.tensor([math.log(span)], dtype=dtype)
    shape = condition_gaussians(3 * quats, 0.1 * quats, scales.log(), spans)
    variance = (0.3 * math.sin(turn)) ** 2 + (span * math.cos(turn)) ** 2
    velocity = (span**2 - 0.3**2) * math.sin(turn) * math.cos(turn) / variance
    torch.testing.assert_close(shape[2], torch.tensor([[velocity, 0, 0]], dtype=dtype))
    torch.testing.assert_close(shape[3].exp(), torch.tensor([variance**0.5], dtype=dtype))
    wanted = torch.tensor([0.3 * span / variance**0.5, 0.05, 0.2], dtype=dtype).square().diag()
    torch.testing.assert_close(covariances(*shape[:2]), wanted[None], rtol=1e-5, atol=1e-8)


def test_the_weight_is_that_of_a_normal_distribution() -> None:
    case = random_case()
    case[6][:4] = torch.tensor([30.0, -30, 3, -3])
    deviations = condition_gaussians(*case[2:6])[3].exp()
    for distance in (1.0, -1.0, 2.4):
        case[1] = 0.3 - distance * deviations
        found = slice_gaussians(*(x.float() for x in case), time=0.3)
        wanted = case[6].sigmoid() * math.exp(-(distance**2) / 2)
        torch.testing.assert_close(found[3].double().sigmoid(), wanted, rtol=1e-5, atol=0)
        assert torch.equal(found[1], condition_gaussians(*(x.float() for x in case[2:6]))[0])


def test_faded_gaussians_are_not_seen_and_have_no_gradient() -> None:
    """Far outside of their life, too, where numbers overflow."""
    case = [x.float() for x in random_case()]
    deviations = condition_gaussians(*case[2:6])[3].exp()
    distances = torch.linspace(0.1, 4, COUNT)
    distances[:2] = torch.tensor([1e9, 1e38])
    case[1] = -distances * deviations
    case = [x.requires_grad_() for x in case]
    outputs = slice_gaussians(*case, time=0.0)
    faded = distances.square() / 2 > -math.log(0.05)
    assert 10 < int(faded.sum()) < 30
    assert torch.equal(outputs[3] == -1e4, faded)
    assert all(x.isfinite().all() for x in outputs)
    grads = torch.autograd.grad(outputs, case, [torch.ones_like(x) for x in outputs])
    for grad in grads:
        assert not grad[faded].any()
        assert grad[~faded].isfinite().all()
        assert grad[~faded].view(int((~faded).sum()), -1).any(1).all()


def test_a_quaternion_of_length_zero_is_the_identity() -> None:
    case = random_case()
    identity = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    for place in (2, 3):
        zero = [x.clone().requires_grad_() for x in case]
        zero[place] = torch.zeros(COUNT, 4, dtype=torch.float64, requires_grad=True)
        one = [*case]
        one[place] = identity.expand(COUNT, 4)
        found = slice_gaussians(*zero, time=0.0)
        for a, b in zip(found, slice_gaussians(*one, time=0.0), strict=True):
            assert torch.equal(a, b)
        (grad,) = torch.autograd.grad(found[0].sum(), zero[place])
        assert not grad.any()


def test_gradients_of_equal_axes_are_finite() -> None:
    """The scales of a ball have the gradients of its size."""
    case = random_case()
    case[3] = conjugate(case[2])
    case[4][:] = -3
    case = [x.requires_grad_() for x in case]
    log_scales = slice_gaussians(*case, time=0.0, min_weight=0)[2]
    by_quats, by_scales = torch.autograd.grad(log_scales.sum(), [case[2], case[4]])
    torch.testing.assert_close(by_scales, torch.ones_like(by_scales))
    torch.testing.assert_close(by_quats, torch.zeros_like(by_quats), rtol=0, atol=1e-12)


@pytest.mark.parametrize("which", range(7))
def test_nan_stays_with_its_gaussian(which: int) -> None:
    case = [x.float() for x in random_case()]
    expected = slice_gaussians(*case, time=0.0)
    case[which].view(COUNT, -1)[17, -1] = float("nan")
    found = slice_gaussians(*case, time=0.0)
    lost = torch.arange(COUNT) == 17
    assert any(x[lost].isnan().any() for x in found)
    for a, b in zip(found, expected, strict=True):
        assert torch.equal(a[~lost], b[~lost])


def test_the_shape_at_all_times_is_that_of_a_slice() -> None:
    case = random_case()
    quats, log_scales, velocities, _ = condition_gaussians(*case[2:6])
    now, later = (slice_gaussians(*case, time=time) for time in (0.25, 0.75))
    assert torch.equal(now[1], quats)
    assert torch.equal(now[2], log_scales)
    torch.testing.assert_close(later[0] - now[0], 0.5 * velocities)


def test_no_gaussians_and_what_does_not_fit() -> None:
    case = random_case()
    assert [len(x) for x in slice_gaussians(*(x[:0] for x in case), time=0.0)] == [0] * 4
    with pytest.raises(DyngsError, match="min_weight must be a number from 0 to 1"):
        slice_gaussians(*case, time=0.0, min_weight=1.5)
    for place in range(7):
        short = [*case]
        short[place] = short[place][1:]
        with pytest.raises(DyngsError, match="slicing"):
            slice_gaussians(*short, time=0.0)


@pytest.mark.parametrize("num_terms", [1, 16])
def test_harmonics_over_time_are_a_cosine_series(num_terms: int) -> None:
    """Of some of the Gaussians; those that are not seen keep the coefficients at their own time."""
    rows = torch.tensor([5, 0, 3, 9])
    seen = torch.tensor([True, True, False, True])
    sh = normal(4, num_terms, 3).requires_grad_()
    sh_time = normal(11, 3 * num_terms, 3, seed=1).requires_grad_()
    elapsed = torch.tensor([0.1, -7.3, 0.2, 1e3 + 0.4]).double().requires_grad_()
    found = harmonics_in_time(sh, sh_time, rows, elapsed, seen)
    phases = 2 * math.pi * torch.arange(1, 4).double() * elapsed[:, None]
    amplitudes = sh_time[rows].view(4, 3, num_terms, 3) * phases.cos()[:, :, None, None]
    expected = sh + amplitudes.sum(1) * seen[:, None, None]
    torch.testing.assert_close(found, expected)
    by = normal(4, num_terms, 3, seed=2)
    grads = [torch.autograd.grad(x, (sh, sh_time, elapsed), by) for x in (found, expected)]
    for a, b in zip(*grads, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)
