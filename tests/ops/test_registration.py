"""Registration of native ops in torch's dispatcher: differentiable once."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._C import DispatchKey, DispatchKeySet

from dyngs.core.errors import DyngsError
from dyngs.ops.adam import adam_step_
from dyngs.ops.hash_grid import HashLevels, hash_features
from dyngs.ops.loss import l1_ssim_loss
from dyngs.ops.nodes import node_penalties
from dyngs.ops.patches import patch_values
from dyngs.ops.perceptron import Layer, perceptron
from dyngs.ops.planes import PlaneLevel, hexplane_features, plane_penalty
from dyngs.ops.posing import pose_by_joints
from dyngs.ops.registration import Backward, register
from dyngs.ops.skinning import blend_skinning

pytestmark = pytest.mark.usefixtures("one_thread")


def _double(x: Tensor, factors: list[float]) -> Tensor:
    return x * 2 * len(factors)


def _double_backward(x: Backward) -> list[Tensor]:
    return [x.grads[0] * 2 * len(x.inputs[1])]


double_op: Any = register("test_double", _double, _double_backward, "x")


def test_custom_op_can_be_registered() -> None:
    torch.library.opcheck(double_op, (torch.ones(3, requires_grad=True), [1.0, 2.0]))


def test_new_device_needs_no_change_of_callers() -> None:
    torch.library.impl("dyngs::test_double", "xpu", lambda x, factors: x * 7)
    found = double_op.redispatch(DispatchKeySet(DispatchKey.XPU), torch.ones(3), [1.0])
    assert found.tolist() == [7, 7, 7]
    assert double_op(torch.ones(3), [1.0]).tolist() == [2, 2, 2]


def test_meta_tensors_give_shapes() -> None:
    assert double_op(torch.ones(3, device="meta"), [1.0]).shape == (3,)


def test_second_derivatives_are_an_error_not_zero() -> None:
    x = torch.ones(3, requires_grad=True)
    y = double_op(x, [1.0]).sum()
    with pytest.raises(DyngsError, match="dyngs::test_double is differentiable once"):
        torch.autograd.grad(y, x, create_graph=True)


X = torch.zeros
LEVEL = PlaneLevel(X(3, 4, 4, 2), X(3, 3, 4, 2))
NODES = (X(4, 3), torch.ones(4), X(5, 2).long(), X(4, 7), X(4, 2))
DO_NOT_FIT: list[Callable[[], object]] = [
    lambda: hexplane_features(X(7, 2), 0.5, [LEVEL]),
    lambda: hexplane_features(X(7, 3).double(), 0.5, [LEVEL]),
    lambda: hexplane_features(X(7, 3), 0.5, [PlaneLevel(LEVEL.space, X(3, 3, 5, 2))]),
    lambda: plane_penalty([PlaneLevel(LEVEL.space, X(3, 3, 4, 3))], (1.0, 1.0, 1.0)),
    lambda: perceptron(X(5, 3), [Layer(X(4, 2), X(4))]),
    lambda: hash_features(X(5, 2), X(8, 2), HashLevels((1.0,), (2,), (8,))),
    lambda: hash_features(X(5, 3), X(9, 2), HashLevels((1.0,), (2,), (8,))),
    lambda: pose_by_joints(X(5, 3), X(5, 4), X(5, 3), X(5, 2), X(3, 3, 4)),
    lambda: blend_skinning(X(4, 3), *NODES),
    lambda: blend_skinning(X(5, 3), *NODES[:2], NODES[2] + 4, *NODES[3:]),
    lambda: node_penalties(X(4, 3), X(4), X(4, 1).long() + 4, X(4, 7), X(4, 5, 3)),
    lambda: patch_values(X(2, 5, 3), X(7).int(), X(7, 2)),
    lambda: patch_values(X(2, 6, 3), X(7), X(7, 2)),
    lambda: patch_values(X(2, 6, 3), X(7).int() + 2, X(7, 2)),
    lambda: adam_step_(X(5), X(4), X(5), X(5), lr=0.1, step=1),
    lambda: adam_step_(X(5), X(5), X(5).double(), X(5), lr=0.1, step=1),
    lambda: adam_step_(X(5, 4).T, X(4, 5), X(4, 5), X(4, 5), lr=0.1, step=1),
    lambda: l1_ssim_loss(X(4, 5, 3), X(4, 6, 3)),
    lambda: l1_ssim_loss(X(4, 5, 3), X(4, 5, 3), mask=X(4, 4)),
]


@pytest.mark.parametrize("call", DO_NOT_FIT)
def test_arrays_that_do_not_fit_are_refused(call: Callable[[], object]) -> None:
    """The core raises before it accesses memory out of bounds."""
    with pytest.raises(DyngsError):
        call()


def test_drawing_imports_neither_the_compiler_of_torch_nor_another_openmp() -> None:
    """Importing torch's compiler would cost every command 2 s. Torch and the core share one thread
    pool.
    """
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
