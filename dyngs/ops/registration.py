"""Registration of ops with torch, calls of the compiled core, and validation of tensors."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
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

P = ParamSpec("P")
R = TypeVar("R")

_LIBRARY = torch.library.Library("dyngs", "FRAGMENT")


class Backward(NamedTuple):
    """Arguments of the backward implementation of an op."""

    inputs: Sequence[Any]  # of the forward pass
    outputs: Sequence[Tensor]  # kept outputs of the forward pass
    grads: Sequence[Tensor]  # by the differentiable outputs
    needs: Sequence[bool]  # whether each gradient is requested


def register(
    name: str,
    kernel: Callable[P, R],
    backward: Callable[[Backward], Sequence[Tensor | list[Tensor] | None]] | None = None,
    by: str = "",
    *,
    keeps: Sequence[int] = (),
    constant: Sequence[int] = (),
    mutates: tuple[str, ...] = (),
) -> Callable[P, R]:
    """Return the op ``torch.ops.dyngs.NAME``, called with positional arguments, for tensors on the
    CPU and, where its core was built, on CUDA GPUs.

    Args:
        kernel: the implementation, whose type hints give the schema; no result may share memory
            with an input.
        backward: implementation of the op ``NAME_backward``, the gradient; returns those by the
            inputs named in ``by``, in the order of the inputs; None where it is not asked for.
        keeps: outputs that ``backward`` needs.
        constant: outputs without a gradient.
        mutates: arguments that it writes to.
    """
    schema = torch.library.infer_schema(kernel, mutates_args=mutates)
    op = _define_op(name, schema, kernel)
    if backward is None:
        return cast(Callable[P, R], op)
    places = [i for i, x in enumerate(signature(kernel).parameters) if x in by.split()]

    def run(*given: Any) -> list[Tensor]:
        *inputs, outputs, grads, needs = given
        found = backward(Backward(inputs, outputs, grads, needs))
        return _tensors(x for x, wanted in zip(found, needs, strict=True) if wanted)

    arguments = schema[1 : schema.index(") ->")]
    extra = "Tensor[] outputs, Tensor[] grads, bool[] needs"
    backward_op = _define_op(f"{name}_backward", f"({arguments}, {extra}) -> Tensor[]", run)

    def below(keys: Any, inputs: Iterable[Any]) -> Any:
        with torch._C._AutoDispatchBelowAutograd():  # pyright: ignore[reportPrivateUsage]
            return op.redispatch(keys & torch._C._after_autograd_keyset, *inputs)  # pyright: ignore[reportPrivateUsage]

    class Recorded(torch.autograd.Function):
        """The op for autograd; half the overhead of ``torch.library.register_autograd``."""

        @staticmethod
        def forward(ctx: Any, keys: Any, inputs: Sequence[Any], *tensors: Tensor) -> Any:
            output = below(keys, inputs)
            outputs = cast("Sequence[Tensor]", output if isinstance(output, tuple) else (output,))
            ctx.mark_non_differentiable(*(outputs[i] for i in constant))
            ctx.inputs = [_without_tensors(x) for x in inputs]
            ctx.save_for_backward(*tensors, *(outputs[i] for i in keeps))
            return cast(Any, output)

        @staticmethod
        def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
            if torch.is_grad_enabled():  # native gradients are not differentiable
                raise DyngsError(f"dyngs::{name} is differentiable once, without create_graph")
            saved = iter(ctx.saved_tensors)
            inputs = [_with_tensors(x, saved) for x in ctx.inputs]
            flags = iter(ctx.needs_input_grad[2:])
            wanted = [[next(flags) for _ in _tensors([x])] for x in inputs]
            needs = [any(wanted[i]) for i in places]
            by_outputs = [x for i, x in enumerate(grads) if i not in constant]
            found = iter(backward_op(*inputs, list(saved), by_outputs, needs))
            return (
                *(None, None),
                *(
                    next(found) if i in places and any(own) else None
                    for i, own in enumerate(wanted)
                    for _ in own
                ),
            )

    def dispatched(keys: Any, *inputs: Any) -> Any:
        if torch.is_grad_enabled() and torch._C._any_requires_grad(*inputs):  # pyright: ignore[reportPrivateUsage]
            return cast(Any, Recorded.apply(keys, inputs, *_tensors(inputs)))
        return below(keys, inputs)

    _LIBRARY.impl(name, dispatched, "Autograd", with_keyset=True)
    return cast(Callable[P, R], op)


def _define_op(name: str, schema: str, kernel: Callable[..., object]) -> Any:
    """Define an op implemented by ``kernel``."""
    _LIBRARY.define(name + schema)
    torch.library.register_fake(f"dyngs::{name}", _shapes_of(kernel), lib=_LIBRARY)
    for device in ("CPU", "CUDA") if has_cuda_core() else ("CPU",):
        _LIBRARY.impl(name, kernel, device)
    return getattr(torch.ops.dyngs, name).default


def _tensors(values: Iterable[Any]) -> list[Tensor]:
    """Return the tensors among ``values``, including those in lists."""
    found: list[Tensor] = []
    for value in values:
        if isinstance(value, Tensor):
            found.append(value)
        elif isinstance(value, list):
            found += _tensors(cast("list[Any]", value))
    return found


def _without_tensors(value: Any) -> Any:
    """Replace tensors in an argument by the class ``Tensor``."""
    if isinstance(value, list):
        return [_without_tensors(x) for x in cast("list[Any]", value)]
    return Tensor if isinstance(value, Tensor) else value


def _with_tensors(value: Any, tensors: Iterator[Tensor]) -> Any:
    """Undo ``_without_tensors`` with the next of ``tensors``."""
    if isinstance(value, list):
        return [_with_tensors(x, tensors) for x in cast("list[Any]", value)]
    return next(tensors) if value is Tensor else value


@dataclass(frozen=True)
class InPlace:
    """Argument of ``launch``: a contiguous tensor that the kernel writes to."""

    tensor: Tensor


@dataclass(frozen=True)
class Struct:
    """Argument of ``launch``: an object of the core's class ``name``."""

    name: str
    fields: tuple[object, ...]


class _Mode(threading.local):
    shapes_only = False


_mode = _Mode()


def shapes_only() -> bool:
    """Return whether an op is traced for shapes only; its inputs then have no data."""
    return _mode.shapes_only


def launch(like: Tensor, name: str, *arguments: object) -> Any:
    """Run ``call_core`` with the number of threads as the last argument."""
    return call_core(like, name, *arguments, num_threads())


def call_core(like: Tensor, name: str, *arguments: object) -> Any:
    """Call the function ``name`` of the compiled core; return None, without a call, while tracing
    shapes.

    ``arguments``: tensors, also in tuples and lists, are passed as arrays. Raises DyngsError if
    the core rejects shapes, types or indices.
    """
    if _mode.shapes_only:
        return None
    core = core_for(like)
    try:
        return getattr(core, name)(*(_to_core(core, x) for x in arguments))
    except (IndexError, TypeError, ValueError) as error:
        raise DyngsError(str(error).split(". ", 1)[0]) from None


def empty_like(x: Tensor) -> Tensor:
    """Allocate an uninitialised contiguous tensor like ``x``."""
    return torch.empty_like(x, memory_format=torch.contiguous_format)


_PLAIN_TYPES = frozenset({int, float, bool, type(None)})


def _to_core(core: ModuleType, value: Any) -> Any:
    """Convert an argument for the core; most of the two hundred per training step are plain."""
    if type(value) in _PLAIN_TYPES:
        return value
    if isinstance(value, Tensor):
        return array(value)
    if isinstance(value, (list, tuple)):
        return tuple(_to_core(core, x) for x in cast(Iterable[Any], value))
    if isinstance(value, InPlace):
        return writable(value.tensor)
    if isinstance(value, Struct):
        return getattr(core, value.name)(*(_to_core(core, x) for x in value.fields))
    return value


def _shapes_of(kernel: Callable[P, R]) -> Callable[P, R]:
    def shapes(*arguments: P.args, **named: P.kwargs) -> R:
        _mode.shapes_only = True
        try:
            return kernel(*arguments, **named)
        finally:
            _mode.shapes_only = False

    return shapes


def has_kernel(device: torch.device) -> bool:
    """Return whether ``device`` has native kernels ("meta": shapes only)."""
    return device.type in ("cpu", "meta") or (device.type == "cuda" and has_cuda_core())


MAX_NUMBER = 3.4e38  # options are computed with in float32

LARGEST_COUNT = 2**31 - 1
MAX_SIDE: int = core.MAX_SIDE  # px; float32 has no pixel centres beyond 2^23

UNCHECKED_BYTES = 1 << 26  # bytes below which free memory is not checked; the check takes 0.1 ms

REMEDY = "lower the resolution, the scales or the number of views"


def check_number(name: str, value: object, low: float, high: float = MAX_NUMBER) -> None:
    """Raise DyngsError unless ``value`` is a number from ``low`` to ``high``."""
    if not isinstance(value, (int, float)) or not low <= value <= high:
        raise DyngsError(f"{name} must be a number from {low:g} to {high:g}, got {value!r}")


def check_tensors(
    op: str,
    tensors: Mapping[str, tuple[Tensor, tuple[int, ...]]],
    dtype: torch.dtype | None = None,
) -> None:
    """Raise DyngsError unless the ``tensors`` have these shapes, one device, and ``dtype``.

    None: any floating point dtype.
    """
    first, device = next((name, x.device) for name, (x, _) in tensors.items())
    for name, (x, shape) in tensors.items():
        if tuple(x.shape) != shape:
            raise DyngsError(f"{op}: {name} must be {shape}, got {tuple(x.shape)}")
        fits = x.is_floating_point() if dtype is None else x.dtype == dtype
        if not fits or x.device != device:
            wanted = f"floating point on {device} like the {first}"
            wanted = wanted if dtype is None else f"{dtype} on {device}"
            raise DyngsError(f"{op}: {name} must be {wanted}, got {x.dtype} on {x.device}")


def check_count(name: str, value: object, low: int, high: int) -> None:
    """Raise DyngsError unless ``value`` is an integer from ``low`` to ``high``."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise DyngsError(f"{name} must be a whole number from {low} to {high}, got {value!r}")


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Raise DyngsError unless ``value`` is one of the ``choices``."""
    if not isinstance(value, str) or value not in choices:
        raise DyngsError(f"{name} must be one of {', '.join(choices)}, got {value!r}")


def check_size(width: int, height: int) -> None:
    """Raise DyngsError unless images of this size can be rendered."""
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise DyngsError(
            f"render refused: an image of {width}x{height} px; its sides can be 1 to {MAX_SIDE} px"
        )


def check_memory(size: int, what: str, like: Tensor) -> None:
    """Raise DyngsError unless ``size`` bytes for ``what`` fit in the available memory.

    The limits are those of the machine, control groups and RLIMIT_AS. Only checked on the CPU:
    torch itself reports exhausted GPU memory. Without system information, 16 GiB are available.
    """
    if shapes_only() or like.device.type != "cpu" or size <= UNCHECKED_BYTES:
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
        launch(x, "count_nonfinite", x, counts[i : i + 1])
    return counts.long()


count_nonfinite_op = register("count_nonfinite", _count_nonfinite)
"""Return (K,) int64: how many numbers of each of K tensors are NaN or infinite."""


def check_finite(tensors: Mapping[str, Tensor], remedy: str = "clean the input") -> None:
    """Raise DyngsError unless all elements of the ``tensors`` (on one device) are finite."""
    counts = count_nonfinite_op([x.detach() for x in tensors.values()])
    for (name, x), count in zip(tensors.items(), counts.cpu().numpy().tolist(), strict=True):
        if count:
            rows = int((~finite_rows([x])).sum())
            raise DyngsError(
                f"{name} holds {count} NaN or infinite value(s) in {rows} of {len(x)} rows; {remedy}"
            )


def finite_rows(tensors: Sequence[Tensor]) -> Tensor:
    """Return (N,) bool: rows that are finite in all tensors (N, ...)."""
    keep = torch.ones(len(tensors[0]), dtype=torch.bool, device=tensors[0].device)
    for x in tensors:
        keep &= torch.isfinite(x.detach()).reshape(len(x), math.prod(x.shape[1:])).all(dim=1)
    return keep
