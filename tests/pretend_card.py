"""Tensors that lie on a device of their own, computed with on the CPU: what a card does not forgive shows without one.

As torch does with real ones, an operator refuses tensors of both devices (but for numbers, and for indices and copies,
for which torch takes both), and NumPy gets none. Whatever makes the host wait for a card is counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_flatten, tree_map

aten: Any = torch.ops.aten
CARD = torch.device("meta")
"""The only device beside the CPU that autograd takes where torch was built without CUDA."""
TAKES_BOTH = (aten._to_copy, aten.copy_, aten.index, aten.index_put_, aten.index_put, aten._index_put_impl_)
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
    """An operator was given tensors of both devices."""


class OnCard(Tensor):
    """A tensor of the card; ``held`` is where its numbers are."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> OnCard:
        made = Tensor._make_wrapper_subclass(
            cls, held.size(), strides=held.stride(), storage_offset=held.storage_offset(), dtype=held.dtype, device=CARD
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
    """The result of an operator, on the device where torch would put it."""
    packet = func.overloadpacket
    given = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, Tensor)]
    on_card = any(isinstance(x, OnCard) for x in given)
    both = on_card and any(not isinstance(x, OnCard) and x.ndim > 0 for x in given)
    if both and (packet not in TAKES_BOTH or not (isinstance(args[0], OnCard) or packet is aten.copy_)):
        shapes = [(str(x.device), tuple(x.shape)) for x in given]
        raise MixedDevices(f"{func}: {shapes}")
    device = kwargs.get("device")
    if device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    to_card = on_card if device is None else torch.device(device) == CARD
    note(packet, args, kwargs, on_card, to_card, waits)

    def taken(x: Any) -> Any:
        return x.held if isinstance(x, OnCard) else x

    result = func(*tree_map(taken, args), **tree_map(taken, kwargs))
    if not to_card:
        return result
    wrapped = tree_map(lambda x: OnCard(x) if isinstance(x, Tensor) and not isinstance(x, OnCard) else x, result)
    return return_and_correct_aliasing(func, args, kwargs, wrapped) if on_card else wrapped


def note(packet: Any, args: Any, kwargs: dict[str, Any], on_card: bool, to_card: bool, waits: Counter[str]) -> None:
    """Count what makes the host wait: numbers read from the card, sizes that depend on them; and what is queued."""
    if on_card and packet in READS_BACK:
        waits[READS_BACK[packet]] += 1
    elif on_card and not to_card:
        waits["to the CPU"] += 1
    elif to_card and not on_card and packet in (aten._to_copy, aten.copy_):
        queued = kwargs.get("non_blocking") or (packet is aten.copy_ and len(args) > 2 and args[2])
        waits["queued to the card" if queued else "to the card"] += 1
    elif packet is aten.copy_ and isinstance(args[1], OnCard) and not isinstance(args[0], OnCard):
        waits["to the CPU"] += 1
    elif packet is aten.index and any(x is not None and x.dtype == torch.bool for x in args[1]) and on_card:
        waits["mask"] += 1


class PretendCard(TorchDispatchMode):
    """The card is there inside this mode; ``waits`` counts by what the host waits for it."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {}, self.waits)


@contextmanager
def pretend_card() -> Iterator[PretendCard]:
    """Inside, tensors may lie on ``CARD``, where all ops compute."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "tensor", made)
        patch.setattr(torch, "as_tensor", lambda x, **how: x.to(**how) if isinstance(x, Tensor) else made(x, **how))
        patch.setattr(
            Tensor, "new_tensor", lambda x, data, **how: made(data, **{"device": x.device, "dtype": x.dtype} | how)
        )
        with PretendCard() as card:
            yield card


def _indices(x: Tensor, index: Any) -> Any:
    """``index`` with tensors in place of lists, for which torch would make some without numbers."""
    if isinstance(index, tuple):
        return tuple(_indices(x, each) for each in index)
    return made(index, device=x.device) if isinstance(index, list) else index


_torch_tensor = torch.tensor


def made(data: Any, *, device: Any = None, requires_grad: bool = False, **how: Any) -> Tensor:
    """``torch.tensor``, which as it is makes one without numbers where the device is called meta."""
    return _torch_tensor(data, **how).to(device or "cpu").requires_grad_(requires_grad)
