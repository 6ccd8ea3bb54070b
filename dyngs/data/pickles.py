"""What pickles hold, read without running anything: numbers, text, containers, and arrays of NumPy, SciPy and chumpy.

Captures of people and body files come as pickles, of Python 2 and 3, of ``numpy.save`` and of joblib.
"""

from __future__ import annotations

import math
import pickle
import re
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from dyngs.errors import DyngsError

_MOST_ENTRIES = 1 << 28
"""Of a sparse matrix, zeros included: more is taken for damage. The regressors of bodies have a million."""


def read_pickle(path: Path) -> object:
    """What a pickle holds, if that is numbers, text, containers and arrays; nothing of the file is executed.

    Pickles of Python 2 and uncompressed ones of joblib are read, too. Sparse matrices of SciPy and arrays of chumpy
    (none of which is needed for it) become plain arrays.

    Raises:
        DyngsError: the file is missing or damaged, or holds anything else.
    """
    return _unpickled(path, is_array=False)


def read_pickled_array(path: Path) -> object:
    """The Python object that ``numpy.save`` wrapped into an array without axes, read as ``read_pickle`` does.

    Raises:
        DyngsError: the file is missing or damaged, or holds something else.
    """
    array = _unpickled(path, is_array=True)
    if not isinstance(array, np.ndarray) or array.shape != () or array.dtype.kind != "O":
        raise DyngsError(f"{path}: must hold one dictionary, saved with numpy.save; export it again")
    return array.item()


class _Dtype:
    """Stands for ``numpy.dtype`` in a pickle: plain numbers, text and objects only."""

    def __init__(self, text: object = None, *_: object) -> None:
        if not isinstance(text, str) or not re.fullmatch(r"[<>|=]?[biufcSUO]\d*", text):
            raise ValueError(f"arrays of type {text!r:.20} are not read")
        self.value = np.dtype(text)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, order, *structure = state[:5]
        if any(part is not None for part in structure):
            raise ValueError("arrays with named fields are not read")
        if order in ("<", ">"):
            self.value = self.value.newbyteorder(order)


class _Array(np.ndarray):
    """Stands for ``numpy.ndarray`` in a pickle, so that NumPy never sees a state that was not checked."""

    source: ClassVar[BinaryIO | None] = None

    def __new__(cls, *_: object) -> _Array:
        return super().__new__(cls, (0,), np.uint8)

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, fortran, raw = self._beside(state) if isinstance(state, dict) else state
        if not isinstance(dtype, _Dtype) or not all(isinstance(n, int) and n >= 0 for n in shape):
            raise ValueError("an array in it has no proper type and shape")
        raw = raw.encode("latin-1") if isinstance(raw, str) else raw  # bytes of Python 2
        is_list = dtype.value.kind == "O"
        wanted = math.prod(shape) * (1 if is_list else dtype.value.itemsize)
        if not isinstance(raw, list if is_list else (bytes, bytearray)) or len(raw) != wanted:
            raise ValueError("an array in it is shorter or longer than its shape")
        raw = raw if is_list else bytes(raw)
        super().__setstate__((1, tuple(shape), dtype.value, bool(fortran), raw))  # type: ignore[arg-type]

    def _become(self, array: np.ndarray) -> None:
        """Take the numbers of another array."""
        super().__setstate__((1, array.shape, array.dtype, False, array.tobytes()))  # type: ignore[arg-type]

    def _beside(self, state: dict[str, Any]) -> tuple[Any, ...]:
        """The state of an array whose bytes joblib wrote into the file behind this entry."""
        shape, dtype = state["shape"], state["dtype"]
        if self.source is None or not isinstance(dtype, _Dtype) or dtype.value.kind == "O":
            raise ValueError("an array in it does not hold numbers")
        if state.get("numpy_array_alignment_bytes") is not None:
            self.source.read(self.source.read(1)[0])
        return 1, shape, dtype, state["order"] == "F", self.source.read(math.prod(shape) * dtype.value.itemsize)


class _Chumpy(_Array):
    """Stands for an array of chumpy, in which SMPL's own files of Python 2 keep theirs; empty where it has none."""

    def __setstate__(self, state: Any) -> None:
        if isinstance(state["x"], np.ndarray):
            self._become(_numbers(state["x"]))


class _Columns(_Array):
    """Stands for a sparse matrix of compressed columns, and becomes the whole matrix."""

    def __setstate__(self, state: Any) -> None:
        rows, columns = state["_shape"]
        self._become(_dense(state, rows, columns))


class _Rows(_Array):
    """Stands for a sparse matrix of compressed rows, and becomes the whole matrix."""

    def __setstate__(self, state: Any) -> None:
        rows, columns = state["_shape"]
        self._become(np.ascontiguousarray(_dense(state, columns, rows).T))


class _Object:
    """Stands for ``object``, which protocols 0 and 1 name as the base of what follows."""


def _numbers(array: object) -> np.ndarray:
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        raise ValueError("an array in it does not hold numbers")
    return array


def _dense(state: dict[str, Any], height: int, width: int) -> np.ndarray:
    """(height, width) of compressed columns."""
    data, row, pointers = (_numbers(state[name]) for name in ("data", "indices", "indptr"))
    counts = np.diff(pointers.astype(np.int64))
    fits = data.ndim == row.ndim == 1 and len(counts) == width and counts.min(initial=0) >= 0
    if not fits or not counts.sum() == len(data) == len(row) or not 0 <= height * width <= _MOST_ENTRIES:
        raise ValueError("a sparse matrix in it is damaged")
    if row.dtype.kind not in "iu" or ((row < 0) | (row >= height)).any():
        raise ValueError("a sparse matrix in it is damaged")
    dense = np.zeros((height, width))
    np.add.at(dense, (row, np.repeat(np.arange(width), counts)), data)
    return dense


def _reconstruct(kind: object, *_: object) -> _Array:
    if not (isinstance(kind, type) and issubclass(kind, _Array)):
        raise ValueError("an array in it is of an unknown class")
    return kind()


def _from_bytes(raw: object, dtype: object, shape: tuple[int, ...], order: str, axes: object = None) -> np.ndarray:
    array = _Array()
    array.__setstate__((1, shape, dtype, order == "F", raw))
    return array if axes is None else array.transpose(axes)  # type: ignore[arg-type]


def _scalar(dtype: object, raw: object) -> Any:
    return _from_bytes(raw, dtype, (), "C")[()]


def _encode(text: str, encoding: str) -> bytes:
    if encoding not in ("latin1", "latin-1"):
        raise ValueError(f"text in it is encoded as {encoding!r:.20}")
    return text.encode("latin-1")


def _no_bytes() -> bytes:
    return b""


_STAND_INS: dict[str, type] = {
    "numpy.ndarray": _Array,
    "numpy.dtype": _Dtype,
    "joblib.numpy_pickle.NumpyArrayWrapper": _Array,
    "builtins.object": _Object,
    **{f"scipy.sparse.csc_{kind}": _Columns for kind in ("matrix", "array")},
    **{f"scipy.sparse.csr_{kind}": _Rows for kind in ("matrix", "array")},
}
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "numpy.core.multiarray._reconstruct": _reconstruct,
    "numpy.core.multiarray.scalar": _scalar,
    "numpy.core.numeric._frombuffer": _from_bytes,
    "copyreg._reconstructor": _reconstruct,
    "_codecs.encode": _encode,
    "collections.OrderedDict": OrderedDict,
    "builtins.set": set,
    "builtins.frozenset": frozenset,
    "builtins.bytes": _no_bytes,
}
_OLD_NAMES = (
    (r"numpy\._core\.", "numpy.core."),
    (r"scipy\.sparse\..*\.(cs[cr]_)", r"scipy.sparse.\1"),
    (r"__builtin__\.", "builtins."),
    (r"copy_reg\.", "copyreg."),
)
"""Patterns at the start of a name, and what is known for it: modules were moved between versions."""


class _Unpickler(pickle._Unpickler):
    """Knows containers and arrays, and no way to anything else.

    The one in C would let a file claim any amount of memory by one number, and reads ahead, where joblib's arrays are.
    """

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file, encoding="latin1")
        self._file = file
        self._own: dict[str, Callable[..., Any]] = {}

    def find_class(self, module: str, name: str) -> Any:
        key = f"{module}.{name}"
        for old, new in _OLD_NAMES:
            key = re.sub(rf"\A{old}", new, key)
        if key not in self._own:  # a file can set attributes of what it is given: never of what others use
            stand_in = _Chumpy if re.match(r"chumpy\.", key) else _STAND_INS.get(key)
            if stand_in is not None:
                self._own[key] = type(stand_in.__name__, (stand_in,), {"source": self._file})
            elif key in _FUNCTIONS:
                self._own[key] = partial(_FUNCTIONS[key])
            else:
                raise pickle.UnpicklingError(f"it holds {key!r:.80}, but only numbers, text and arrays are read")
        return self._own[key]


def _unpickled(path: Path, is_array: bool) -> object:
    if not path.is_file():
        raise DyngsError(f"{path}: no such file; restore it")
    try:
        with path.open("rb") as file:
            if is_array:
                _skip_array_header(file)
            return _Unpickler(file).load()
    except Exception as error:  # a damaged pickle raises nearly anything
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise DyngsError(
            f"{path}: cannot be read as a pickle ({reason}); copy it again, or export it as arrays"
        ) from None


def _skip_array_header(file: BinaryIO) -> None:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    if read(file)[2].kind != "O":
        raise ValueError("an array of Python objects was expected")
