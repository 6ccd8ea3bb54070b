"""The native ops as ops of the dispatcher: all are checked, clear where not implemented,
differentiable once."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._C import DispatchKey, DispatchKeySet

from dyngs.core.errors import DyngsError
from dyngs.ops.planes import PlaneLevel, hexplane_features
from dyngs.ops.registration import Gradient, count_nonfinite_op, has_kernel, implement, register
from dyngs.ops.skinning import blend_skinning

pytestmark = pytest.mark.usefixtures("one_thread")


def _double(x: Tensor, factors: list[float]) -> Tensor:
    return x * 2 * len(factors)


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.count = len(inputs[1])


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
    return grad * 2 * ctx.count, None


double_op = register("test_double", _double, devices=("cpu",), gradient=Gradient(_save, _backward))


def on(device: DispatchKey, op: Any, *arguments: object) -> Any:
    """What ``op`` gives where its tensors lie on another device, which this machine need not
    have."""
    return op.redispatch(DispatchKeySet(device), *arguments)


def test_an_op_of_ones_own() -> None:
    torch.library.opcheck(double_op, (torch.ones(3, requires_grad=True), [1.0, 2.0]))


def test_where_it_is_not_implemented_the_device_is_named() -> None:
    with pytest.raises(
        DyngsError, match=r"dyngs::test_double has no implementation for tensors on cpu; move all"
    ):
        on(DispatchKey.CUDA, double_op, torch.ones(3), [1.0])
    with pytest.raises(DyngsError, match=r"dyngs::count_nonfinite has no implementation"):
        on(DispatchKey.MPS, count_nonfinite_op, [torch.ones(3)])


def test_another_device_joins_without_a_change_of_callers() -> None:
    assert not has_kernel("test_double", torch.device("xpu"))
    implement("test_double", "xpu", lambda x, factors: x * 7)
    assert has_kernel("test_double", torch.device("xpu", 0))
    assert on(DispatchKey.XPU, double_op, torch.ones(3), [1.0]).tolist() == [7, 7, 7]
    assert double_op(torch.ones(3), [1.0]).tolist() == [2, 2, 2]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu_the_line_names_it() -> None:
    with pytest.raises(
        DyngsError, match=r"no implementation for tensors on cuda:0; move all of them to the CPU"
    ):
        double_op(torch.ones(3, device="cuda"), [1.0])


def test_meta_tensors_give_shapes() -> None:
    assert double_op(torch.ones(3, device="meta"), [1.0]).shape == (3,)


def second_derivative(first: tuple[Tensor, ...], source: Tensor) -> None:
    with pytest.raises(
        DyngsError, match=r"dyngs::\w+ is differentiable once; a second derivative was asked for"
    ):
        torch.autograd.grad(sum(x.square().sum() for x in first), source)


def test_second_derivatives_are_an_error_not_zero() -> None:
    generator = torch.Generator().manual_seed(0)
    points, motion, values = (
        torch.randn(4, n, generator=generator).requires_grad_() for n in (3, 7, 2)
    )
    nodes = (
        torch.randn(4, 3, generator=generator),
        torch.ones(4),
        torch.tensor([[0], [1], [2], [3]]),
    )
    total = sum(x.sum() for x in blend_skinning(points, *nodes, motion, values))
    plain = torch.autograd.grad(total, (points, motion, values), retain_graph=True)
    first = torch.autograd.grad(total, (points, motion, values), create_graph=True)
    assert all(torch.equal(a, b) for a, b in zip(first, plain, strict=True))
    second_derivative(first, motion)


def test_second_derivatives_of_lists_of_tensors_are_an_error_too() -> None:
    level = PlaneLevel(
        torch.ones(3, 4, 4, 2).requires_grad_(), torch.ones(3, 3, 4, 2).requires_grad_()
    )
    features = hexplane_features(torch.zeros(5, 3), 0.5, [level])
    first = torch.autograd.grad(features.sum(), (level.space, level.time), create_graph=True)
    second_derivative(first, level.space)


def test_drawing_imports_neither_the_compiler_of_torch_nor_another_openmp() -> None:
    """The former takes 2 s of CPU, which every command would pay; torch and the core share one pool
    of threads."""
    code = (
        "import sys, torch\n"
        "from dyngs import Cameras, Gaussians, render\n"
        "g = Gaussians(*(torch.ones(5, *n, requires_grad=True) for n in ((3,), (4,), (3,), (), (1, 3))))\n"
        "pose, lens = torch.eye(4)[None], torch.tensor([[[9.0, 0, 4], [0, 9, 4], [0, 0, 1]]])\n"
        "render(g, Cameras(pose, lens, 8, 8)).rgb.sum().backward()\n"
        "print([m for m in ('torch._dynamo', 'torch._inductor') if m in sys.modules])\n"
        "from dyngs.cli.doctor import openmp_runtimes\n"
        "print(len(openmp_runtimes() or [1]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stdout.split() == ["[]", "1"], done.stderr
