"""Registration of ops with torch, and checks of their tensors."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from inspect import signature
from types import ModuleType
from typing import Any, NamedTuple, ParamSpec, TypeVar, cast

import torch
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.ops.native import array, core, core_for, has_cuda_core, num_threads, writable

# pyright: reportUnknownMemberType=false
# The stubs of torch leave parts of these functions untyped.


NAMESPACE = "dyngs"

P = ParamSpec("P")
R = TypeVar("R")

_LIBRARY = torch.library.Library(NAMESPACE, "FRAGMENT")
_kernels: dict[str, set[str]] = {}  # devices of each op's implementations


@dataclass(frozen=True)
class Gradient:
    """Formula of the first derivatives of an op, as of a ``torch.autograd.Function``."""

    # called as ``save(ctx, inputs, output)`` after the forward pass, keeps what the formula needs
    save: Callable[[Any, tuple[Any, ...], Any], None]
    # called as ``backward(ctx, *gradients of the outputs)``, returns one gradient per input; for an
    # input that is a list of tensors, a list
    backward: Callable[..., Any]


def register(
    name: str,
    kernel: Callable[P, R],
    *,
    devices: tuple[str, ...] = ("cpu", "cuda"),
    mutates: tuple[str, ...] = (),
    gradient: Gradient | None = None,
) -> Callable[P, R]:
    """Return the op ``torch.ops.dyngs.NAME``, called with positional arguments; elsewhere it raises
    DyngsError.

    ``kernel``: the implementation, whose type hints give the schema; no result may share memory
    with an input. ``devices``: for whose tensors it is; CUDA counts only where its core was built.
    ``mutates``: arguments that it writes to.
    """
    schema = torch.library.infer_schema(kernel, mutates_args=mutates)
    op = _defined(name, schema, kernel, devices)
    if gradient is not None:
        formula = _first_order(f"{NAMESPACE}::{name}", gradient.backward)
        if re.search(r"Tensor\??\[\]", schema):  # lists of tensors, which autograd has no place for
            torch.library.register_autograd(
                f"{NAMESPACE}::{name}", formula, setup_context=gradient.save, lib=_LIBRARY
            )
        else:
            _LIBRARY.impl(
                name, _with_gradient(op, gradient.save, formula), "Autograd", with_keyset=True
            )
    return cast(Callable[P, R], op)


def _defined(
    name: str, schema: str, kernel: Callable[..., object], devices: tuple[str, ...]
) -> Any:
    """Return the new op with an implementation for ``devices``, and an error elsewhere."""
    _LIBRARY.define(name + schema)
    torch.library.register_fake(f"{NAMESPACE}::{name}", _shapes_of(kernel), lib=_LIBRARY)
    # for every device that has none of its own
    _LIBRARY.impl(name, _refusal(name), "CompositeExplicitAutograd")
    _kernels[name] = {"meta"}
    for device in devices:
        if device != "cuda" or has_cuda_core():
            implement(name, device, kernel)
    return getattr(getattr(torch.ops, NAMESPACE), name).default


class Backward(NamedTuple):
    """Inputs of the implementation of a gradient."""

    inputs: Sequence[Any]  # of the forward pass
    outputs: Sequence[Tensor]  # those of the forward pass that ``differentiable`` keeps
    grads: Sequence[Tensor]  # by the differentiable outputs
    needs: Sequence[bool]  # whether each of the gradients is asked for


def differentiable(
    name: str,
    kernel: Callable[P, R],
    backward: Callable[[Backward], Sequence[Tensor | None]],
    by: str,
    *,
    keeps: Sequence[int] = (),
    constant: Sequence[int] = (),
) -> Callable[P, R]:
    """Return the op ``NAME`` as ``register`` does; its gradient is the op ``NAME_backward``.

    Args:
        kernel: takes no lists of tensors.
        backward: implementation that returns the gradients by the inputs named in ``by``, in this
            order; what is not asked for may be None.
        keeps: outputs that ``backward`` needs.
        constant: outputs without a gradient.
    """
    schema = torch.library.infer_schema(kernel, mutates_args=())
    arguments = schema[1 : schema.index(") ->")]
    names = list(signature(kernel).parameters)
    places = [names.index(one) for one in by.split()]

    def run(*given: Any) -> list[Tensor]:
        *inputs, outputs, grads, needs = given
        found = backward(Backward(inputs, outputs, grads, needs))
        return [x for x, wanted in zip(found, needs, strict=True) if wanted and x is not None]

    extra = "Tensor[] outputs, Tensor[] grads, bool[] needs"
    backward_op = _defined(
        f"{name}_backward", f"({arguments}, {extra}) -> Tensor[]", run, ("cpu", "cuda")
    )

    def save(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        outputs = cast("tuple[Tensor, ...]", output if isinstance(output, tuple) else (output,))
        ctx.mark_non_differentiable(*(outputs[i] for i in constant))
        ctx.tensors = [i for i, x in enumerate(inputs) if isinstance(x, Tensor)]
        ctx.others = [None if isinstance(x, Tensor) else x for x in inputs]
        kept = [outputs[i] for i in keeps]
        ctx.save_for_backward(*(inputs[i] for i in ctx.tensors), *kept)

    def gradient(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        saved = list(ctx.saved_tensors)
        inputs = list(ctx.others)
        for i in ctx.tensors:
            inputs[i] = saved.pop(0)
        by_outputs = [g for i, g in enumerate(grads) if i not in constant]
        needs = [ctx.needs_input_grad[i] for i in places]
        found = iter(backward_op(*inputs, saved, by_outputs, needs))
        results: list[Tensor | None] = [None] * len(inputs)
        for i, wanted in zip(places, needs, strict=True):
            results[i] = next(found) if wanted else None
        return tuple(results)

    return register(name, kernel, gradient=Gradient(save, gradient))


def _with_gradient(
    op: Any, save: Callable[..., None], formula: Callable[..., Any]
) -> Callable[..., Any]:
    """Return ``op`` for tensors that may require gradients, as ``torch.library.register_autograd``
    in half the time."""

    def below(keys: Any, arguments: tuple[Any, ...]) -> Any:
        with torch._C._AutoDispatchBelowAutograd():  # pyright: ignore[reportPrivateUsage]
            return op.redispatch(keys & torch._C._after_autograd_keyset, *arguments)  # pyright: ignore[reportPrivateUsage]

    class Recorded(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, *arguments: Any) -> Any:  # the last are the keys
            output = below(arguments[-1], arguments[:-1])
            save(ctx, arguments[:-1], output)
            return output

        @staticmethod
        def backward(ctx: Any, *grads: Tensor | None) -> Any:
            results = formula(ctx, *grads)
            return (*results, None) if isinstance(results, tuple) else (results, None)

    def dispatched(keys: Any, *arguments: Any) -> Any:
        wanted = torch.is_grad_enabled() and torch._C._any_requires_grad(*arguments)  # pyright: ignore[reportPrivateUsage]
        return cast(Any, Recorded.apply(*arguments, keys)) if wanted else below(keys, arguments)

    return dispatched


@dataclass(frozen=True)
class InPlace:
    """A contiguous tensor that a kernel writes to, as an argument of ``launch``."""

    tensor: Tensor


@dataclass(frozen=True)
class Struct:
    """An object of the core, of its class ``name``, as an argument of ``launch``."""

    name: str
    fields: tuple[object, ...]


class _Mode(threading.local):
    shapes_only = False


_mode = _Mode()


def shapes_only() -> bool:
    """Return whether an implementation is asked for the shapes of its results alone: its inputs
    have no data."""
    return _mode.shapes_only


def launch(like: Tensor, name: str, *arguments: object) -> Any:
    """Return what the function ``name`` of the core gives; None, without calling it, where only
    shapes are needed.

    ``arguments``: tensors, those written to included, are passed as arrays, also those in tuples
    and lists.
    """
    if _mode.shapes_only:
        return None
    core = core_for(like)
    return getattr(core, name)(*_each(core, arguments))


def empty_like(x: Tensor) -> Tensor:
    """Return an uninitialised contiguous tensor like ``x``."""
    return torch.empty_like(x, memory_format=torch.contiguous_format)


_PLAIN = frozenset({int, float, bool, type(None)})


def _each(core: ModuleType, values: Iterable[object]) -> list[Any]:
    """Return ``values`` as the core takes them; of the two hundred that a training step passes most
    are plain."""
    return [
        array(x) if type(x) is Tensor else x if type(x) in _PLAIN else _passed(core, x)
        for x in values
    ]


def _passed(core: ModuleType, value: Any) -> Any:
    if isinstance(value, Tensor):
        return array(value)
    if isinstance(value, (list, tuple)):
        return tuple(_each(core, cast(Iterable[object], value)))
    if isinstance(value, InPlace):
        return writable(value.tensor)
    if isinstance(value, Struct):
        return getattr(core, value.name)(*_each(core, value.fields))
    return value


def _shapes_of(kernel: Callable[P, R]) -> Callable[P, R]:
    def shapes(*arguments: P.args, **named: P.kwargs) -> R:
        _mode.shapes_only = True
        try:
            return kernel(*arguments, **named)
        finally:
            _mode.shapes_only = False

    return shapes


def implement(name: str, device: str, kernel: Callable[..., object]) -> None:
    """Make ``kernel`` the implementation of the op ``name`` for tensors on ``device``, for example
    ``"cuda"``."""
    _LIBRARY.impl(name, kernel, device.upper())
    _kernels[name].add(device)


def has_kernel(name: str, device: torch.device) -> bool:
    """Return whether the op ``name`` is implemented on ``device``; where it is not, plain torch may
    do."""
    return device.type in _kernels[name]


def _refusal(name: str) -> Callable[..., Any]:
    def refuse(*arguments: object) -> None:
        devices = sorted({str(x.device) for x in _tensors(arguments)})
        raise DyngsError(
            f"{NAMESPACE}::{name} has no implementation for tensors on {' and '.join(devices)}; "
            "move all of them to the CPU with .to('cpu')"
        )

    return refuse


def _tensors(values: Iterable[object]) -> list[Tensor]:
    found: list[Tensor] = []
    for value in values:
        if isinstance(value, Tensor):
            found.append(value)
        elif isinstance(value, (list, tuple)):
            found += _tensors(cast(Iterable[object], value))
    return found


def _first_order(qualified: str, backward: Callable[..., Any]) -> Callable[..., Any]:
    """Return the formula ``backward`` made one whose results raise an error when they are
    differentiated again.

    Why: the native backward ops have no derivative, and without this their second derivatives would
    count as zero.
    """

    def formula(ctx: Any, *grads: Tensor | None) -> Any:
        if not torch.is_grad_enabled():
            return backward(ctx, *grads)
        with torch.no_grad():
            results = backward(ctx, *grads)
        sources = [x for x in (*_tensors(grads), *ctx.saved_tensors) if x.requires_grad]
        return _guarded(qualified, results, sources) if sources else results

    return formula


def _guarded(qualified: str, results: Any, sources: list[Tensor]) -> Any:
    """Return ``results`` (a tensor, None, or a tuple or list of such) with an error as the gradient
    of each tensor."""
    if isinstance(results, (list, tuple)):
        guarded = [_guarded(qualified, x, sources) for x in cast(Iterable[object], results)]
        return guarded if isinstance(results, list) else tuple(guarded)
    return (
        cast(Any, _Undifferentiable.apply(qualified, results, *sources))
        if isinstance(results, Tensor)
        else results
    )


class _Undifferentiable(torch.autograd.Function):
    """A tensor as it is, whose gradient by ``sources`` is an error."""

    @staticmethod
    def forward(ctx: Any, qualified: str, x: Tensor, *sources: Tensor) -> Tensor:
        ctx.qualified = qualified
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> None:
        raise DyngsError(
            f"{ctx.qualified} is differentiable once; a second derivative was asked for"
        )


LARGEST = 3.4e38  # options are computed with in float32

LARGEST_COUNT = 2**31 - 1
MAX_SIDE: int = core.MAX_SIDE  # px; float32 has no pixel centres beyond 2^23

UNASKED = 1 << 26  # bytes up to which the free memory is not asked for, because asking takes 0.1 ms

REMEDY = "lower the resolution, the scales or the number of views"


def check_number(name: str, value: object, low: float, high: float = LARGEST) -> None:
    """Raise an error unless ``value`` is a number from ``low`` to ``high``."""
    if not isinstance(value, (int, float)) or not low <= value <= high:
        upto = (
            ""
            if high == math.inf
            else " and finite"
            if high == LARGEST
            else f" and at most {high:g}"
        )
        raise DyngsError(f"{name} must be a number of at least {low:g}{upto}, got {value!r}")


def check_tensors(
    op: str,
    tensors: Mapping[str, tuple[Tensor, tuple[int, ...]]],
    dtype: torch.dtype | None = None,
) -> None:
    """Raise an error unless the ``tensors`` of ``op`` have these shapes, one device, and ``dtype``
    (None: floating point)."""
    first, device = next((name, x.device) for name, (x, _) in tensors.items())
    for name, (x, shape) in tensors.items():
        if tuple(x.shape) != shape:
            raise DyngsError(f"{op}: {name} must be {shape}, got {tuple(x.shape)}")
        fits = x.is_floating_point() if dtype is None else x.dtype == dtype
        if not fits or x.device != device:
            wanted = f"floating point on {device} like the {first}"
            wanted = wanted if dtype is None else f"{dtype} on {device}"
            raise DyngsError(f"{op}: {name} must be {wanted}, got {x.dtype} on {x.device}")


def check_near_and_far(near: object, far: object) -> None:
    """Raise an error unless they are the limits of a range of depths; ``far`` may be infinite."""
    check_number("near", near, 0)
    check_number("far", far, 0, math.inf)
    if not far > near:  # pyright: ignore[reportOperatorIssue]
        raise DyngsError(f"far must lie beyond near, got near {near!r} and far {far!r}")


def check_count(name: str, value: object, low: int, high: int) -> None:
    """Raise an error unless ``value`` is a whole number from ``low`` to ``high``."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise DyngsError(f"{name} must be a whole number from {low} to {high}, got {value!r}")


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Raise an error unless ``value`` is one of the ``choices``."""
    if not isinstance(value, str) or value not in choices:
        raise DyngsError(f"{name} must be one of {', '.join(choices)}, got {value!r}")


def check_size(width: int, height: int) -> None:
    """Raise an error unless images of this size can be drawn."""
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise DyngsError(
            f"render refused: an image of {width}x{height} px; its sides can be 1 to {MAX_SIDE} px"
        )


def check_memory(size: int, what: str, like: Tensor) -> None:
    """Raise an error unless ``size`` bytes for ``what`` fit what machine, control groups and
    RLIMIT_AS leave free.

    Only where ``like`` lies on the CPU: in a GPU's memory torch itself refuses what does not fit.
    Raises DyngsError: with both figures. (Where the system does not say, more than 16 GiB at once
    is refused.)
    """
    if shapes_only() or like.device.type != "cpu" or size <= UNASKED:
        return
    available = core.available_memory()
    if size > available:
        needed, left = (f"{x / 1e9:.1f} GB" for x in (size, available))
        raise DyngsError(
            f"render refused: {what} take {needed}; {left} of memory are available; {REMEDY}"
        )


def _count_nonfinite(tensors: list[Tensor]) -> Tensor:
    counts = tensors[0].new_zeros(len(tensors), dtype=torch.int32)
    for i, x in enumerate(tensors):
        launch(x, "count_nonfinite", x, counts[i : i + 1], num_threads())
    return counts.long()


count_nonfinite_op = register("count_nonfinite", _count_nonfinite)
"""Return (K,) int64: how many numbers of each of K tensors are NaN or infinite."""


def check_finite(tensors: Mapping[str, Tensor], remedy: str = "clean the input") -> None:
    """Raise an error unless every element of the ``tensors`` (float32 or float64, on one device) is
    finite."""
    given = [x.detach() for x in tensors.values()]
    if has_kernel("count_nonfinite", given[0].device):
        counts = count_nonfinite_op(given)
    else:
        counts = torch.stack([(~x.isfinite()).sum() for x in given])
    for (name, x), count in zip(tensors.items(), counts.cpu().numpy().tolist(), strict=True):
        if count:
            rows = int((~finite_rows([x])).sum())
            raise DyngsError(
                f"{name} holds {count} NaN or infinite value(s) in {rows} of {len(x)} rows; {remedy}"
            )


def finite_rows(tensors: Sequence[Tensor]) -> Tensor:
    """Return (N,) bool: the rows that are finite in all of the tensors (N, ...)."""
    keep = torch.ones(len(tensors[0]), dtype=torch.bool, device=tensors[0].device)
    for x in tensors:
        keep &= torch.isfinite(x.detach()).reshape(len(x), math.prod(x.shape[1:])).all(dim=1)
    return keep
