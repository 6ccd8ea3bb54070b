"""Arrays in pickles: interpretation of the few classes and functions that their writers name,
without calling them.

A name in a pickle becomes a ``Name``, which is only text; ``Arrays`` rebuilds the arrays that calls
of these names by NumPy, SciPy, chumpy or joblib stand for.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.io.limits import require_at_most
from dyngs.io.numpy_files import require_text

_MOST_ENTRIES = 1 << 24
"""Entries of all sparse matrices of a file, zeros included; joint regressors of bodies have half a
million."""
_MOST_AXES = 32
_LARGEST_AXIS = 1 << 48
_MOST_LEVELS = 8
"""Nesting of arrays of objects; NumPy frees them by recursion."""
_BYTES_PER_BYTE = 16
"""Bytes of arrays per byte of the file: a reference to an object takes 8, and 2 in a pickle."""

_ARRAYS = {
    "numpy.ndarray": "plain",
    "joblib.numpy_pickle.NumpyArrayWrapper": "plain",
    **{f"scipy.sparse.csc_{kind}": "columns" for kind in ("matrix", "array")},
    **{f"scipy.sparse.csr_{kind}": "rows" for kind in ("matrix", "array")},
}
ORDERED = "collections.OrderedDict"
"""A container with keys; its calls are left to the unpickler, which checks them."""
_OLD_NAMES = (
    (r"numpy\._core\.", "numpy.core."),
    (r"scipy\.sparse\..*\.(cs[cr]_)", r"scipy.sparse.\1"),
    (r"__builtin__\.", "builtins."),
    (r"copy_reg\.", "copyreg."),
)
"""Patterns of old and new module names to the name used here: modules moved between versions."""


@dataclass(frozen=True)
class Name:
    """A class or function named in a pickle, by its current name."""

    text: str

    @property
    def array(self) -> str | None:
        """Layout of the array in the state of such an object, None if it is no array."""
        return "chumpy" if self.text.startswith("chumpy.") else _ARRAYS.get(self.text)


class Dtype:
    """Stands for ``numpy.dtype``: plain numbers, text and objects only."""

    def __init__(self, text: object) -> None:
        if not isinstance(text, str) or not re.fullmatch(r"[<>|=]?[biufcSUO]\d{0,9}", text):
            raise ValueError(f"arrays of type {shown(text)} are not read")
        self.value = np.dtype(text)


class Array(np.ndarray):
    """An array out of a pickle.

    Attributes:
        awaits: how the state that will fill it spells the array; None once it is filled, which
            happens but once.
        levels: of arrays of objects in each other, itself counted.
    """

    awaits: str | None = None
    levels: int = 0


def shown(value: object) -> str:
    """Return a short text for messages: strings, numbers and None as they are, else the name of the
    type."""
    return (
        repr(value)[:20]
        if isinstance(value, (str, float, bool, type(None)))
        else type(value).__name__
    )


class Arrays:
    """Interpretation of the names in one pickle, a file of ``size`` bytes; ``read`` returns the
    next bytes of it."""

    def __init__(self, path: Path, size: int, read: Callable[[int], bytes]) -> None:
        self._path, self._read = path, read
        self._bytes_left = _BYTES_PER_BYTE * size + (1 << 16)
        self.sparse_entries = 0
        """Entries of the sparse matrices so far, zeros included."""

    def named(self, module: object, name: object) -> Name:
        """Return the name ``module.name``; raises ValueError for unknown ones."""
        if not isinstance(module, str) or not isinstance(name, str):
            raise ValueError("a class in it has no proper name")
        key = f"{module[:200]}.{name[:200]}"
        for old, new in _OLD_NAMES:
            key = re.sub(rf"\A{old}", new, key)
        found = Name(key)
        if found.array is None and key not in (*_CALLS, ORDERED, "numpy.dtype", "builtins.object"):
            raise ValueError(f"it holds {key!r:.80}, but only numbers, text and arrays are read")
        return found

    def called(self, name: object, arguments: object) -> object:
        """Return the object that a call stands for; raises exceptions of any kind for wrong
        arguments."""
        if not isinstance(name, Name) or not isinstance(arguments, tuple):
            raise ValueError("it calls what is no function")
        if name.array is not None:
            return _awaiting(name.array)
        if name.text == "numpy.dtype":
            return Dtype(arguments[0] if arguments else None)
        if name.text not in _CALLS:
            raise ValueError(
                f"it makes a {name.text!r:.40}, but only numbers, text and arrays are read"
            )
        return _CALLS[name.text](self, *arguments)

    def build(self, target: object, state: object) -> None:
        """Set the state of ``target``, made by ``called``; raises exceptions of any kind for a
        wrong state."""
        if isinstance(target, Dtype):
            _set_order(target, state)
            return
        if not isinstance(target, Array) or target.awaits is None:
            raise ValueError("it sets the state of what has none")
        spelled = target.awaits
        target.awaits = None
        if spelled == "plain":
            self._fill(target, self._beside(state) if isinstance(state, dict) else state)
        elif not isinstance(state, dict):
            raise ValueError("an array in it has no proper state")
        elif spelled == "chumpy":  # empty where it has no numbers
            if isinstance(state["x"], np.ndarray):
                self._become(target, _numbers(state["x"]))
        else:
            height, width = state["_shape"] if spelled == "columns" else reversed(state["_shape"])
            dense = self._dense(state, height, width)
            self._become(target, dense if spelled == "columns" else np.ascontiguousarray(dense.T))

    def charge(self, count: int) -> None:
        """Count bytes of memory allocated for the file; raises ValueError if there are too many for
        its size."""
        self._bytes_left -= count
        if self._bytes_left < 0:
            raise ValueError("it makes many large arrays out of the same bytes")

    def _fill(self, target: Array, state: Any) -> None:
        _, shape, dtype, fortran, raw = state
        if not isinstance(dtype, Dtype):
            raise ValueError("an array in it has no proper type and shape")
        count = _count(shape)
        kind = dtype.value.kind
        raw = raw.encode("latin-1") if isinstance(raw, str) else raw  # bytes of Python 2
        wanted = count * (1 if kind == "O" else dtype.value.itemsize)
        if not isinstance(raw, list if kind == "O" else (bytes, bytearray)) or len(raw) != wanted:
            raise ValueError("an array in it is shorter or longer than its shape")
        self.charge(8 * count if kind == "O" else wanted)
        if isinstance(raw, list):
            target.levels = _levels(raw)
        else:
            raw = bytes(raw)
            require_text(raw, dtype.value)
        target.__setstate__((1, tuple(shape), dtype.value, bool(fortran), raw))  # type: ignore[arg-type]

    def _become(self, target: Array, array: np.ndarray) -> None:
        """Copy the numbers of another array."""
        self.charge(array.nbytes)
        target.__setstate__((1, array.shape, array.dtype, False, array.tobytes()))  # type: ignore[arg-type]

    def _beside(self, state: dict[str, Any]) -> tuple[Any, ...]:
        """State of an array whose bytes joblib wrote into the file after this entry."""
        shape = state["shape"]
        dtype = state["dtype"]
        if not isinstance(dtype, Dtype) or dtype.value.kind == "O":
            raise ValueError("an array in it does not hold numbers")
        if state.get("numpy_array_alignment_bytes") is not None:
            self._read(self._read(1)[0])
        return (
            1,
            shape,
            dtype,
            state["order"] == "F",
            self._read(_count(shape) * dtype.value.itemsize),
        )

    def _dense(self, state: dict[str, Any], height: Any, width: Any) -> np.ndarray:
        """Return the dense (height, width) array of a matrix of compressed columns."""
        data, row, pointers = (_numbers(state[name]) for name in ("data", "indices", "indptr"))
        entries = _count((height, width))
        fits = data.ndim == row.ndim == pointers.ndim == 1 and len(pointers) == width + 1
        if not fits or not len(data) == len(row) or row.dtype.kind not in "iu":
            raise ValueError("a sparse matrix in it is damaged")
        self.sparse_entries += entries
        require_at_most(
            self._path, self.sparse_entries, _MOST_ENTRIES, "entries of sparse matrices"
        )
        counts = np.diff(pointers.astype(np.int64))
        if (
            counts.min(initial=0) < 0
            or counts.sum() != len(data)
            or ((row < 0) | (row >= height)).any()
        ):
            raise ValueError("a sparse matrix in it is damaged")
        self._bytes_left += 8 * entries  # which are counted above
        dense = np.zeros((height, width))
        np.add.at(dense, (row, np.repeat(np.arange(width), counts)), data)
        return dense

    def _reconstruct(self, kind: object, *_: object) -> Array:
        if not isinstance(kind, Name) or kind.array is None:
            raise ValueError("an array in it is of an unknown class")
        return _awaiting(kind.array)

    def _from_bytes(
        self, raw: object, dtype: object, shape: object, order: object, axes: object = None
    ) -> np.ndarray:
        if not isinstance(dtype, Dtype) or dtype.value.kind == "O":
            raise ValueError("an array in it does not hold numbers")
        array = Array((0,), np.uint8)
        self._fill(array, (1, shape, dtype, order == "F", raw))
        return array if axes is None else array.transpose(axes)  # type: ignore[arg-type]

    def _scalar(self, dtype: object, raw: object) -> Any:
        return self._from_bytes(raw, dtype, (), "C")[()]

    def _encode(self, text: object, encoding: object = "latin1") -> bytes:
        if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
            raise ValueError(f"text in it is encoded as {shown(encoding)}")
        self.charge(len(text))
        return text.encode("latin-1")

    def _no_bytes(self) -> bytes:
        return b""


_CALLS: dict[str, Callable[..., object]] = {
    "numpy.core.multiarray._reconstruct": Arrays._reconstruct,
    "numpy.core.multiarray.scalar": Arrays._scalar,
    "numpy.core.numeric._frombuffer": Arrays._from_bytes,
    "copyreg._reconstructor": Arrays._reconstruct,
    "_codecs.encode": Arrays._encode,
    "builtins.bytes": Arrays._no_bytes,
}


def _awaiting(spelled: str) -> Array:
    array = Array((0,), np.uint8)
    array.awaits = spelled
    return array


def _set_order(dtype: Dtype, state: Any) -> None:
    _, order, *structure = state[:5]
    if any(part is not None for part in structure):
        raise ValueError("arrays with named fields are not read")
    if isinstance(order, str) and order in ("<", ">"):
        dtype.value = dtype.value.newbyteorder(order)


def _count(shape: object) -> int:
    """Number of entries of an array of that shape."""
    fits = isinstance(shape, (tuple, list)) and len(shape) <= _MOST_AXES
    axes: list[Any] = list(shape) if fits else [None]  # type: ignore[call-overload]
    if not all(isinstance(n, (int, np.integer)) and 0 <= n < _LARGEST_AXIS for n in axes):
        raise ValueError("an array in it has no proper type and shape")
    return math.prod(int(n) for n in axes)


def _levels(items: list[object]) -> int:
    """Nesting depth of arrays of objects, that of ``items`` included."""
    inside = [item for item in items if isinstance(item, Array)]
    levels = 1 + max((array.levels for array in inside), default=0)
    if levels > _MOST_LEVELS or any(array.awaits is not None for array in inside):
        raise ValueError("arrays in it lie too deep in each other")
    return levels


def _numbers(array: object) -> np.ndarray:
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        raise ValueError("an array in it does not hold numbers")
    return array
