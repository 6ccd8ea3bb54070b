"""Checks common to all ops.

Exact gradients, equal bytes for any number of threads, equal values on every instruction set, and
support of torch's dispatcher and compiler.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
from op_cases import CASES
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import dyngs.ops
from dyngs.ops.native import kernel_threads
from dyngs.ops.registration import _LIBRARY

DIFFERENTIABLE = [name for name in CASES if name not in ("tally", "adam", "offsets")]
COMPILED = [
    name for name in DIFFERENTIABLE if name not in ("field", "patches", "render", "boundaries")
]


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_gradients_are_those_of_finite_differences(name: str) -> None:
    case = CASES[name](4, torch.float64)
    count = len(case.inputs) - case.num_signals
    signals = [x.detach() for x in case.inputs[count:]]

    def differentiable(*inputs: Tensor) -> tuple[Tensor, ...]:
        return tuple(y for y in case.run(*inputs, *signals) if y.requires_grad)

    assert torch.autograd.gradcheck(differentiable, case.inputs[:count], fast_mode=True)


@pytest.mark.parametrize("name", CASES)
def test_any_number_of_threads_gives_the_same_bytes(name: str) -> None:
    case = CASES[name](1500 if name != "render" else 300, torch.float32)
    with kernel_threads(1):
        expected = case.results()
    for threads in (2, 8):
        with kernel_threads(threads):
            found = case.results()
        for a, b in zip(found, expected, strict=True):
            assert torch.equal(a.nan_to_num(), b.nan_to_num())


@pytest.mark.parametrize("name", [name for name in CASES if name != "field"])
def test_float_on_every_isa_is_near_double(isa: str, name: str) -> None:
    """Ray samples may differ in number; test_rays.py compares those."""
    found = CASES[name](40, torch.float32).results()
    expected = CASES[name](40, torch.float64).results()
    for a, b in zip(found, expected, strict=True):
        if a.is_floating_point():
            scale = float(b.abs().max())
            torch.testing.assert_close(a.double(), b, rtol=1e-3, atol=1e-4 * scale, msg=isa)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_strides_do_not_matter(name: str) -> None:
    case = CASES[name](40, torch.float32)
    expected = case.results()
    strided = [x.detach().flatten().repeat_interleave(2)[::2].view(x.shape) for x in case.inputs]
    case = type(case)(case.run, tuple(x.requires_grad_() for x in strided), case.num_signals)
    for a, b in zip(case.results(), expected, strict=True):
        torch.testing.assert_close(a, b)


class Recorder(TorchDispatchMode):
    """Arguments of the first call of each op, and of each call with other arguments set to None."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: dict[tuple[str, str], tuple[Any, tuple[Any, ...]]] = {}

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] = {}
    ) -> Any:
        if func.namespace == "dyngs":
            pattern = "".join("-" if x is None else "x" for x in args)
            name = func._schema.name.removeprefix("dyngs::")
            self.calls.setdefault((name, pattern), (func, tuple(map(detached, args))))
        return func(*args, **kwargs)


def detached(x: Any) -> Any:
    """A detached copy of an op's argument."""
    if isinstance(x, list):
        return [detached(y) for y in x]
    return x.detach().clone() if isinstance(x, Tensor) else x


def with_gradients(x: Any) -> Any:
    if isinstance(x, list):
        return [with_gradients(y) for y in x]
    return x.requires_grad_() if isinstance(x, Tensor) and x.is_floating_point() else x


@pytest.mark.usefixtures("one_thread")
def test_every_op_is_well_behaved() -> None:
    """Runs ``torch.library.opcheck``: schema, fake kernel, autograd registration, tracing."""
    for path in Path(dyngs.ops.__path__[0]).glob("[a-z]*.py"):
        import_module(f"dyngs.ops.{path.stem}")
    with Recorder() as recorder:
        for case in CASES.values():
            case(12, torch.float32).results()
    names = (name.removeprefix("dyngs::") for name in _LIBRARY._op_defs)
    wanted = {name for name in names if not name.startswith("test_")}
    assert {name for name, _ in recorder.calls} == wanted
    for (name, _), (op, args) in recorder.calls.items():
        given = list(args)
        if name == "perceptron":
            given[-1] = False  # nobody writes the padding between the activations that are kept
        if name == "perceptron_backward":
            given[-3] = [torch.empty(0)]
        differentiable = "backward" not in name and torch._C._dispatch_has_kernel_for_dispatch_key(
            f"dyngs::{name}", "Autograd"
        )
        torch.library.opcheck(op, tuple(map(with_gradients, given) if differentiable else given))


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("name", COMPILED)
def test_compiles_into_one_graph(name: str) -> None:
    case = CASES[name](12, torch.float32)
    run: Callable[..., Any] = torch.compile(case.run, fullgraph=True, backend="aot_eager")
    compiled = type(case)(run, case.inputs, case.num_signals)
    for a, b in zip(compiled.results(), case.results(), strict=True):
        torch.testing.assert_close(a, b)
