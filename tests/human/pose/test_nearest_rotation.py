"""Rotations nearest to matrices, against the SVD in float64, and quaternions of rotations, against scipy."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.human.pose.nearest_rotation import nearest_rotations, quats_of

EYE = torch.eye(3, dtype=torch.float64)
AMBIGUOUS = {
    "rank one": torch.diag(torch.tensor([1.0, 0, 0])),
    "rank one, no axis": torch.ones(3, 3),
    "zero": torch.zeros(3, 3),
    "point reflection": -torch.eye(3),
    "mirror": torch.diag(torch.tensor([1.0, 1, -1])),
    "equal and opposite": torch.diag(torch.tensor([2.0, -1, 1])),
    "blend of opposite turns": 0.5 * (torch.eye(3) + torch.diag(torch.tensor([-1.0, -1, 1]))),
}
"""Matrices with s2 + s3 = 0: several rotations are nearest."""


def decomposed(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest rotations and the signed singular values, by the SVD in float64."""
    u, s, vt = torch.linalg.svd(matrices.double())
    sign = torch.linalg.det(u @ vt).round()
    s, u = s.clone(), u.clone()
    s[..., 2] *= sign
    u[..., 2] *= sign[..., None]
    return u @ vt, s


def random_rotations(count: int, seed: int = 0) -> Tensor:
    quats = np.random.default_rng(seed).normal(size=(count, 4))
    return torch.from_numpy(Rotation.from_quat(quats).as_matrix())


def random_matrices(count: int, noise: float = math.inf) -> Tensor:
    """Rotations with some noise, or nothing but noise."""
    generator = torch.Generator().manual_seed(3)
    matrices = torch.randn(count, 3, 3, dtype=torch.float64, generator=generator)
    return matrices if math.isinf(noise) else random_rotations(count) + noise * matrices


def assert_rotations(matrices: Tensor, atol: float = 1e-13) -> None:
    matrices = matrices.detach().double()
    torch.testing.assert_close(matrices.mT @ matrices, EYE.expand_as(matrices), rtol=0, atol=atol)
    assert bool((torch.linalg.det(matrices) > 0).all())


def matrix_of(quat: Tensor) -> Tensor:
    """(3, 3) of a wxyz quaternion of any length."""
    return torch.from_numpy(Rotation.from_quat(quat.detach().double().roll(-1).numpy()).as_matrix())


# --- the nearest rotation ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 1e-9, 1e-3, 0.3, math.inf])
def test_as_the_svd(noise: float) -> None:
    """Half of the purely random ones are reflections. Errors grow with the inverse square of s2 + s3."""
    matrices = random_matrices(200, noise)
    expected, s = decomposed(matrices)
    found = nearest_rotations(matrices)
    error = (found - expected).abs().amax((1, 2)) * ((s[:, 1] + s[:, 2]) / s[:, 0]) ** 2
    assert float(error.max()) < 1e-13
    assert_rotations(found)


@settings(max_examples=60, deadline=None)
@given(
    arrays(np.float64, (3, 3), elements=st.sampled_from([-2.0, -1.0, -0.5, 0.0, 1e-9, 0.5, 1.0, 3.0])),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_no_rotation_is_nearer(entries: np.ndarray, dtype: torch.dtype) -> None:
    """tr(R^T A) reaches s1 + s2 + s3, for singular matrices and ties as well, and all is finite."""
    matrix = torch.from_numpy(entries).to(dtype).requires_grad_()
    found = nearest_rotations(matrix)
    found.backward(torch.arange(9.0).reshape(3, 3).to(dtype))
    assert matrix.grad is not None
    assert bool(matrix.grad.isfinite().all())
    reached = float((found.double() * matrix.double()).sum().detach())
    best = float(decomposed(matrix.detach())[1].sum())
    # Entries of R are rounded by half a unit of float32, and those of A add up to at most 9 times the largest: 5e-7.
    assert reached == pytest.approx(best, rel=0, abs=1e-6 * float(matrix.detach().abs().max()))
    assert_rotations(found, atol=8 * torch.finfo(dtype).eps)


def test_rotations_stay_and_turn_along() -> None:
    """R(A) = A for rotations; R(Q A Q') = Q R(A) Q' for any rotations Q, Q'."""
    turns, others = random_rotations(50), random_rotations(50, seed=1)
    torch.testing.assert_close(nearest_rotations(turns), turns, rtol=0, atol=1e-14)
    assert torch.equal(nearest_rotations(EYE), EYE)
    matrices = random_matrices(50, 0.3)
    expected = turns @ nearest_rotations(matrices) @ others
    torch.testing.assert_close(nearest_rotations(turns @ matrices @ others), expected, rtol=0, atol=1e-12)


def test_half_of_two_turns_is_the_turn_halfway() -> None:
    """What a point that follows two bones alike does."""
    turns = [torch.from_numpy(Rotation.from_rotvec([0, 0, angle]).as_matrix()) for angle in (0.2, 2.8, 1.5)]
    torch.testing.assert_close(nearest_rotations(0.5 * turns[0] + 0.5 * turns[1]), turns[2], rtol=0, atol=1e-14)


@pytest.mark.parametrize("exponent", [-60, -30, 30, 60])
def test_size_does_not_matter(exponent: int) -> None:
    """Powers of two change no bit; gradients shrink by them."""
    matrices = random_matrices(20, 0.3).float()
    base, scaled = (x.clone().requires_grad_() for x in (matrices, matrices * 2.0**exponent))
    results = [nearest_rotations(x) for x in (base, scaled)]
    assert torch.equal(*results)
    for x in results:
        x.backward(torch.arange(9.0).reshape(3, 3).expand_as(x))
    assert base.grad is not None
    assert scaled.grad is not None
    torch.testing.assert_close(scaled.grad * 2.0**exponent, base.grad, rtol=1e-6, atol=0)


def test_float32_is_as_good_as_its_input() -> None:
    matrices = random_matrices(300, 0.1).float()
    found = nearest_rotations(matrices)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), decomposed(matrices)[0], rtol=0, atol=1e-7)


def test_any_batch() -> None:
    """Also an empty one, one that is not contiguous, and one longer than what is worked on at a time."""
    matrices = random_matrices(9000, 0.3)
    at_once = nearest_rotations(matrices)
    rows = torch.tensor([0, 8191, 8192, 8999])
    close = partial(torch.testing.assert_close, rtol=0, atol=1e-14)  # sums of few and of many differ in their order
    close(at_once[rows], torch.stack([nearest_rotations(matrices[i]) for i in rows]))
    close(nearest_rotations(matrices[:12].reshape(3, 4, 3, 3)), at_once[:12].reshape(3, 4, 3, 3))
    close(nearest_rotations(matrices[:6].mT.contiguous().mT), at_once[:6])
    nothing = torch.zeros(0, 3, 3, requires_grad=True)
    nearest_rotations(nothing).sum().backward()
    assert nearest_rotations(nothing).shape == (0, 3, 3)
    assert quats_of(nothing).shape == (0, 4)


def test_the_same_bits_on_any_number_of_threads(set_threads: Callable[[int], None]) -> None:
    matrices, grad = random_matrices(20_000, 0.3).float(), random_matrices(20_000).float()
    results = []
    for count in (1, 2):
        set_threads(count)
        x = matrices.clone().requires_grad_()
        found = nearest_rotations(x)
        found.backward(grad)
        results.append((found.detach(), x.grad))
    for one, two in zip(*results, strict=True):
        assert one is not None
        assert two is not None
        assert torch.equal(one, two)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_stays_with_its_matrix(bad: float) -> None:
    matrices = random_matrices(3, 0.3)
    expected = nearest_rotations(matrices)
    matrices[1, 2, 0] = bad
    found = nearest_rotations(matrices)
    assert bool(found[1].isnan().all())
    torch.testing.assert_close(found[::2], expected[::2], rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", AMBIGUOUS)
def test_of_several_a_small_turn_is_taken_with_finite_gradients(name: str) -> None:
    matrix = AMBIGUOUS[name].clone().requires_grad_()
    found = nearest_rotations(matrix)
    quats_of(found).backward(torch.tensor([1.0, 2, 3, 4]))
    assert_rotations(found, atol=1e-6)
    assert matrix.grad is not None
    assert float(matrix.grad.abs().max()) < 1e5  # and not NaN; clipped
    if name == "zero":
        assert not matrix.grad.any()
    angle = math.acos(min(1.0, (float(found.detach().trace()) - 1) / 2))
    assert angle == pytest.approx(math.pi if name == "point reflection" else 0.0, abs=1e-3)


@pytest.mark.parametrize("stretch", [(1, 0, 0), (1, 1, -1), (1, -0.5, 0.5), (-1, -1, -1), (1, 1e-7, 1e-7)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ambiguous_about_any_axes(stretch: tuple[float, ...], dtype: torch.dtype) -> None:
    """Roots that are double or triple up to rounding: the best value is reached, and all is finite."""
    size = torch.diag(torch.tensor(stretch, dtype=torch.float64))
    matrices = (random_rotations(400) @ size @ random_rotations(400, seed=1)).to(dtype).requires_grad_()
    found = nearest_rotations(matrices)
    found.backward(random_matrices(400).to(dtype))
    assert matrices.grad is not None
    assert float(matrices.grad.abs().max()) < 1e5
    assert_rotations(found, atol=8 * torch.finfo(dtype).eps)
    reached = (found * matrices).sum((1, 2)).detach().double()
    torch.testing.assert_close(reached, torch.full_like(reached, max(1.0, sum(stretch))), rtol=0, atol=1e-6)


def test_what_only_knows_an_axis_does_not_turn() -> None:
    """n n^T is as near to all turns about n."""
    axes = random_rotations(100)[:, :, :1]
    found = nearest_rotations(axes @ axes.mT)
    torch.testing.assert_close(found, EYE.expand_as(found), rtol=0, atol=1e-5)


# --- its gradient -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 0.3, math.inf])
def test_gradients_against_finite_differences(noise: float) -> None:
    """For rotations all singular values are 1: the gradient of an SVD would be NaN."""
    matrices = random_matrices(5, noise).requires_grad_()
    assert torch.autograd.gradcheck(nearest_rotations, matrices)
    assert torch.autograd.gradcheck(lambda x: quats_of(nearest_rotations(x)), matrices)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_at_the_identity_the_gradient_is_the_skew_part(dtype: torch.dtype) -> None:
    matrix = torch.eye(3, dtype=dtype, requires_grad=True)
    grad = torch.tensor([[1.0, 2, 3], [5, 7, 11], [13, 17, 19]], dtype=dtype)
    nearest_rotations(matrix).backward(grad)
    torch.testing.assert_close(matrix.grad, 0.5 * (grad - grad.T), rtol=4e-6, atol=1e-6)


def test_stretch_has_no_gradient() -> None:
    """Along A the rotation does not change."""
    matrices = random_matrices(50, 0.3).requires_grad_()
    nearest_rotations(matrices).backward(random_matrices(50))
    assert matrices.grad is not None
    slope = (matrices.grad * matrices.detach()).sum((1, 2))
    torch.testing.assert_close(slope, torch.zeros_like(slope), rtol=0, atol=1e-12)


def test_gradients_of_nearly_singular_matrices_in_float32() -> None:
    """s2 + s3 = 1e-3: some digits remain."""
    turns, others = random_rotations(50), random_rotations(50, seed=1)
    matrices = turns @ torch.diag(torch.tensor([1.0, 0.5, -0.499], dtype=torch.float64)) @ others
    grads = []
    for dtype in (torch.float32, torch.float64):
        x = matrices.to(dtype).requires_grad_()
        nearest_rotations(x).backward(random_matrices(50).to(dtype))
        assert x.grad is not None
        grads.append(x.grad.double())
    apart = (grads[0] - grads[1]).norm(dim=(1, 2)) / grads[1].norm(dim=(1, 2))
    assert float(apart.max()) < 0.02


# --- quaternions ------------------------------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(st.lists(st.sampled_from([-1.0, -0.6, -1e-9, 0.0, 1e-9, 0.3, 1.0]), min_size=4, max_size=4).filter(any))
def test_quaternions_give_the_rotation_back(numbers: list[float]) -> None:
    """Of any rotation: half turns, and those with two or more components equally large."""
    quat = torch.nn.functional.normalize(torch.tensor(numbers, dtype=torch.float64), dim=0)
    found = quats_of(matrix_of(quat))
    torch.testing.assert_close(found * (found @ quat).sign(), quat, rtol=0, atol=1e-14)
    assert float(found.max()) > float(found.abs().max()) - 1e-12


def test_known_quaternions() -> None:
    assert quats_of(torch.eye(3)).tolist() == [1, 0, 0, 0]
    for axis in range(3):
        half_turn = 2 * torch.diag(torch.nn.functional.one_hot(torch.tensor(axis), 3)).float() - torch.eye(3)
        assert quats_of(half_turn).tolist() == [float(k == axis + 1) for k in range(4)]
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert quats_of(quarter).tolist() == pytest.approx([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])


def test_quaternions_are_unit_even_if_the_matrix_is_not_quite_a_rotation() -> None:
    quats = quats_of(random_matrices(200, 0.01).float())
    torch.testing.assert_close(quats.norm(dim=1), torch.ones(200), rtol=0, atol=3e-7)


def test_gradients_of_quaternions() -> None:
    """Wherever which component is the largest: each is, somewhere."""
    turns = random_rotations(20)
    assert set(quats_of(turns).abs().argmax(1).tolist()) == {0, 1, 2, 3}
    assert torch.autograd.gradcheck(quats_of, turns.requires_grad_())
    half_turns = torch.stack([torch.diag(torch.tensor(x, dtype=torch.float64)) for x in ([1.0, -1, -1], [1, 1, 1])])
    assert torch.autograd.gradcheck(quats_of, half_turns.requires_grad_())


@pytest.mark.parametrize("axis", [[1.0, 0, 0], [0, 1, 0], [0.6, 0, -0.8], [0.5, 0.5, math.sqrt(0.5)]])
def test_a_growing_turn_grows_in_its_quaternion(axis: list[float]) -> None:
    """The whole chain: w = cos(angle / 2) falls by sin(angle / 2) / 2, on both sides of a half turn."""
    for angle in (0.0, 0.5, math.pi - 1e-3, math.pi, math.pi + 1e-3, 6.0):
        a = torch.tensor(angle, dtype=torch.float64, requires_grad=True)
        x, y, z = axis
        skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
        quat = quats_of(nearest_rotations(EYE + a.sin() * skew + (1 - a.cos()) * skew @ skew))
        expected = torch.tensor([math.cos(angle / 2), *(math.sin(angle / 2) * c for c in axis)], dtype=torch.float64)
        sign = float((quat.detach() @ expected).sign())
        (slope,) = torch.autograd.grad(quat[0] * sign, a)
        assert float(slope) == pytest.approx(-0.5 * math.sin(angle / 2), abs=1e-9)
