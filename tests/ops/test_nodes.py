"""Control nodes at a time and the penalties of their motion, against plain torch in float64."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dyngs.ops.nodes import (
    HEAD_SIZES,
    cubic_fractions,
    node_penalties,
    spline_motion,
)
from dyngs.ops.quaternions import identity_quat, rotate

NODES, POINTS = 37, 9


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def splines(kept: int = 0b11111, count: int = NODES) -> list[Tensor | None]:
    """Control points of the heads whose bits are in ``kept``."""
    return [
        normal(count, POINTS, size, seed=head).requires_grad_() if kept >> head & 1 else None
        for head, size in enumerate(HEAD_SIZES)
    ]


def there(heads: list[Tensor | None]) -> list[Tensor]:
    return [x for x in heads if x is not None]


def plain_motion(heads: list[Tensor | None], time: float) -> tuple[Tensor, Tensor]:
    place = min(max(time, 0.0), 1.0) * (POINTS - 3)
    piece = min(int(place), POINTS - 4)
    weights = torch.tensor(cubic_fractions(place - piece), dtype=torch.float64)
    found = [
        None if x is None else torch.einsum("k,skd->sd", weights, x[:, piece : piece + 4])
        for x in heads
    ]
    means = found[0]
    quats = found[1]
    assert means is not None
    turns = identity_quat(means).expand(len(means), 4) + (0 if quats is None else quats)
    return torch.cat([means, turns], 1), torch.cat([means[:, :0], *there(found[1:])], 1)


def graph() -> tuple[Tensor, Tensor, Tensor]:
    """Positions, radii and neighbours, of which some are shared."""
    neighbours = torch.randint(NODES, (NODES, 3), generator=torch.Generator().manual_seed(1))
    return normal(NODES, 3), 0.5 + normal(NODES).abs(), neighbours


def plain_penalties(
    positions: Tensor, radii: Tensor, neighbours: Tensor, motion: Tensor, paths: Tensor
) -> Tensor:
    arms = positions[neighbours] - positions[:, None]
    shifts = motion[:, :3]
    quats = motion[:, None, 3:].expand(-1, arms.shape[1], -1)
    strain = arms + shifts[neighbours] - shifts[:, None] - rotate(quats, arms)
    bends = (paths.diff(n=2, dim=1) / radii[:, None, None]).square().mean()
    return torch.stack([bends, (strain / radii[:, None, None]).square().sum(-1).mean()])


def with_gradients(outputs: Tensor | tuple[Tensor, ...], leaves: list[Tensor]) -> list[Tensor]:
    outputs = outputs if isinstance(outputs, tuple) else (outputs,)
    grads = [normal(*y.shape, seed=5).to(y.dtype) for y in outputs]
    return [*(y.detach() for y in outputs), *torch.autograd.grad(outputs, leaves, grads)]


def as_leaves(tensors: list[Tensor | None], dtype: torch.dtype) -> list[Tensor | None]:
    return [None if x is None else x.detach().to(dtype).requires_grad_() for x in tensors]


@pytest.mark.parametrize("kept", [0b1, 0b11, 0b11101, 0b11111])
@pytest.mark.parametrize("time", [-1.0, 0.0, 0.37, 1.0])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-6)])
def test_motion_equals_torch(kept: int, time: float, dtype: torch.dtype, tolerance: float) -> None:
    heads = splines(kept)
    expected = with_gradients(plain_motion(heads, time), there(heads))
    heads = as_leaves(heads, dtype)
    for x, y in zip(
        with_gradients(spline_motion(heads, time), there(heads)), expected, strict=True
    ):
        torch.testing.assert_close(x.double(), y, rtol=0, atol=tolerance)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_penalties_equal_torch(dtype: torch.dtype, tolerance: float) -> None:
    leaves = [
        normal(NODES, 7, seed=2).requires_grad_(),
        normal(NODES, POINTS, 3, seed=3).requires_grad_(),
    ]
    expected = with_gradients(plain_penalties(*graph(), *leaves), leaves)
    leaves = [x.detach().to(dtype).requires_grad_() for x in leaves]
    positions, radii, neighbours = graph()
    found = with_gradients(
        node_penalties(positions.to(dtype), radii.to(dtype), neighbours, *leaves), leaves
    )
    for x, y in zip(found, expected, strict=True):
        torch.testing.assert_close(
            x.double(), y, rtol=0, atol=tolerance * max(1.0, float(y.abs().max()))
        )
