"""A simulated GPU for tests: its tensors have a device of their own and compute on the CPU.

As in torch, an operator raises for tensors on both devices, except scalars, indices and copies.
Conversion to NumPy raises. Operations that synchronise with the host are counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing

aten: Any = torch.ops.aten
GPU = torch.device("meta")
"""The only device beside the CPU that autograd takes where torch was built without CUDA."""
TAKES_BOTH = (
    aten._to_copy,
    aten.copy_,
    aten.index,
    aten.index_put_,
    aten.index_put,
    aten._index_put_impl_,
)
READS_BACK = {
    aten._local_scalar_dense: "item",
    aten.nonzero: "nonzero",
    aten.masked_select: "masked_select",
    aten.equal: "equal",
    aten.unique_consecutive: "unique",
    aten._unique2: "unique",
    aten.unique_dim: "unique",
    aten.repeat_interleave: "repeat_interleave",
    aten.bincount: "bincount",
}


class MixedDevices(RuntimeError):
    """An operator was called with tensors on both devices."""


class OnGpu(Tensor):
    """A tensor on the simulated GPU; ``held`` is its CPU storage."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> OnGpu:
        made = Tensor._make_wrapper_subclass(
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=GPU,
        )
        made.held = held
        return made

    def __getitem__(self, index: Any) -> Tensor:
        return super().__getitem__(_indices(self, index))

    def __setitem__(self, index: Any, value: Any) -> None:
        super().__setitem__(_indices(self, index), value)

    def __repr__(self, *, tensor_contents: object = None) -> str:
        return f"OnCard({self.held!r})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {}, Counter())


def computed(func: Any, args: Any, kwargs: dict[str, Any], waits: Counter[str]) -> Any:
    """The result of an operator on the device that torch would choose."""
    each = (
        y for x in (*args, *kwargs.values()) for y in (x if isinstance(x, list | tuple) else (x,))
    )
    given = [x for x in each if isinstance(x, Tensor)]
    on_gpu = any(isinstance(x, OnGpu) for x in given)
    device = kwargs.get("device")
    to_gpu = on_gpu if device is None else torch.device(device) == GPU
    if not on_gpu and not to_gpu:
        return func(*args, **kwargs)
    packet = func.overloadpacket
    both = on_gpu and any(not isinstance(x, OnGpu) and x.ndim > 0 for x in given)
    if both and (
        packet not in TAKES_BOTH or not (isinstance(args[0], OnGpu) or packet is aten.copy_)
    ):
        raise MixedDevices(f"{func}: {[(str(x.device), tuple(x.shape)) for x in given]}")
    note(packet, args, kwargs, on_gpu, to_gpu, waits)
    options = {
        name: torch.device("cpu") if name == "device" else held(x) for name, x in kwargs.items()
    }
    result = func(*map(held, args), **options)
    if not to_gpu:
        return result
    there = lies_there(result)
    return (
        return_and_correct_aliasing(func, args, kwargs, there)
        if on_gpu and returns_given(func)
        else there
    )


def lies_there(x: Any) -> Any:
    """An operator's result with CPU tensors replaced by simulated GPU tensors."""
    if isinstance(x, list | tuple):
        return type(x)(map(lies_there, x))
    return OnGpu(x) if isinstance(x, Tensor) and not isinstance(x, OnGpu) else x


@cache
def returns_given(func: Any) -> bool:
    """True if an operator's result is, or contains, one of its arguments."""
    return any(x.alias_info is not None for x in func._schema.returns)


def held(x: Any) -> Any:
    """An operator's argument with simulated GPU tensors replaced by their CPU storage."""
    if isinstance(x, OnGpu):
        return x.held
    return [held(y) for y in x] if isinstance(x, list | tuple) else x


def note(
    packet: Any, args: Any, kwargs: dict[str, Any], on_gpu: bool, to_gpu: bool, waits: Counter[str]
) -> None:
    """Count host synchronisations (values read, data-dependent sizes) and queued operations."""
    if on_gpu and packet in READS_BACK:
        waits[READS_BACK[packet]] += 1
    elif on_gpu and not to_gpu:
        waits["to the CPU"] += 1
    elif to_gpu and not on_gpu and packet in (aten._to_copy, aten.copy_):
        queued = kwargs.get("non_blocking") or (packet is aten.copy_ and len(args) > 2 and args[2])
        waits["queued to the GPU" if queued else "to the GPU"] += 1
    elif packet is aten.copy_ and isinstance(args[1], OnGpu) and not isinstance(args[0], OnGpu):
        waits["to the CPU"] += 1
    elif (
        packet is aten.index
        and any(x is not None and x.dtype == torch.bool for x in args[1])
        and on_gpu
    ):
        waits["mask"] += 1


class PretendGpu(TorchDispatchMode):
    """A mode in which the simulated GPU exists; ``waits`` counts synchronisations by reason."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {}, self.waits)


@contextmanager
def pretend_gpu() -> Iterator[PretendGpu]:
    """Return a context in which tensors may lie on ``CARD`` and all ops support it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "tensor", made)
        patch.setattr(
            torch,
            "as_tensor",
            lambda x, **how: x.to(**how) if isinstance(x, Tensor) else made(x, **how),
        )
        patch.setattr(
            Tensor,
            "new_tensor",
            lambda x, data, **how: made(data, **{"device": x.device, "dtype": x.dtype} | how),
        )
        with PretendGpu() as gpu:
            yield gpu


def _indices(x: Tensor, index: Any) -> Any:
    """``index`` with lists replaced by tensors, because torch would create meta tensors for lists."""
    if isinstance(index, tuple):
        return tuple(_indices(x, each) for each in index)
    return made(index, device=x.device) if isinstance(index, list) else index


_torch_tensor = torch.tensor


def made(data: Any, *, device: Any = None, requires_grad: bool = False, **how: Any) -> Tensor:
    """``torch.tensor`` for ``CARD``; the original returns meta tensors without values."""
    return _torch_tensor(data, **how).to(device or "cpu").requires_grad_(requires_grad)
