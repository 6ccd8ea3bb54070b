"""Reading of pickles without executing them: numbers, text, containers, arrays of NumPy, SciPy and
chumpy.

Captures of people and body templates are distributed as pickles of Python 2 and 3, of
``numpy.save`` and of joblib. Python's own unpickler reads them here with those instructions only
that make such values, and a class or function named in a pickle becomes a ``_Name``, which is only
text. Time and memory are linear in the size of the file.
"""

from __future__ import annotations

import io
import math
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.io.fields import require_at_most
from dyngs.io.numpy_files import array_header, require_text

_MOST_ENTRIES = 1 << 20
"""Entries, shared ones counted at each occurrence, next to two per byte of the file and those of
sparse matrices."""
_MOST_CONTAINERS = 1 << 22
"""Limit on containers, their marks, and remembered values."""
_MOST_SPARSE_ENTRIES = 1 << 24
"""Entries of all sparse matrices of a file, zeros included; joint regressors of bodies have half a
million."""
_DEEPEST = 100  # containers in each other
_LONGEST_KEY = 4096
_LARGEST_KEY = 1 << 31  # a file can choose larger numbers whose hashes collide
_BYTES_PER_BYTE = 16
"""Bytes of copies per byte of the file: a reference to an object takes 8, and 2 in a pickle."""

_VALUES = (
    "NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT STRING "
    "BINSTRING SHORT_BINSTRING BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8 UNICODE BINUNICODE "
    "SHORT_BINUNICODE BINUNICODE8 EMPTY_TUPLE APPEND APPENDS SETITEM SETITEMS POP POP_MARK DUP "
    "GET BINGET LONG_BINGET GLOBAL STACK_GLOBAL BUILD PROTO FRAME STOP"
)
_CONTAINERS = (
    "EMPTY_LIST EMPTY_DICT LIST DICT TUPLE TUPLE1 TUPLE2 TUPLE3 MARK PUT BINPUT LONG_BINPUT "
    "MEMOIZE REDUCE NEWOBJ"
)
"""Names of the instructions that are read; these are counted."""
_LAYOUTS = {
    "numpy.ndarray": "plain",
    "joblib.numpy_pickle.NumpyArrayWrapper": "plain",
    **{f"scipy.sparse.csc_{kind}": "columns" for kind in ("matrix", "array")},
    **{f"scipy.sparse.csr_{kind}": "rows" for kind in ("matrix", "array")},
    "chumpy": "chumpy",
}
"""Classes of arrays, and how their state holds the numbers."""
_OTHER_NAMES = {
    "numpy.dtype",
    "numpy.core.multiarray._reconstruct",
    "numpy.core.multiarray.scalar",
    "numpy.core.numeric._frombuffer",
    "copyreg._reconstructor",
    "_codecs.encode",
    "builtins.bytes",
    "builtins.object",
    "collections.OrderedDict",
}
_OLD_NAMES = (
    (r"numpy\._core\.", "numpy.core."),
    (r"scipy\.sparse\..*\.(cs[cr]_)", r"scipy.sparse.\1"),
    (r"__builtin__\.", "builtins."),
    (r"copy_reg\.", "copyreg."),
    (r"chumpy\..*", "chumpy"),
)
"""Patterns of module names to the name used here: modules moved between versions."""


def read_pickle(path: Path) -> object:
    """Read a pickle of numbers, text, containers and arrays; nothing in the file is executed.

    Pickles of Python 2 and uncompressed ones of joblib are read, too. Sparse matrices of SciPy and
    arrays of chumpy become plain arrays; chumpy is not needed. The result never contains
    itself and is at most 100 containers deep. With shared parts counted at each occurrence, it has
    at most two entries per byte of the file and a million more, next to those of sparse matrices.

    Raises:
        DyngsError: the file is missing or damaged, or holds anything else, or asks for too much.
    """
    return _unpickled(path, is_array=False)


def read_pickled_array(path: Path) -> object:
    """Read the Python object that ``numpy.save`` wrapped into a 0-dimensional array, as
    ``read_pickle`` does."""
    array = _unpickled(path, is_array=True)
    if not isinstance(array, np.ndarray) or array.shape != () or array.dtype.kind != "O":
        raise DyngsError(
            f"{path}: must hold one dictionary, saved with numpy.save; export it again"
        )
    return array.item()


def _unpickled(path: Path, is_array: bool) -> object:
    if not path.is_file():
        raise DyngsError(f"{path}: no such file; restore it")
    with wrap_read_errors(path, "it must be a pickle; copy it again, or export it as arrays"):
        content = path.read_bytes()
        file = io.BytesIO(content)
        if is_array and array_header(file)[2].kind != "O":
            raise ValueError("expected an array of Python objects")
        return _Unpickler(path, file, len(content)).load()


class _Name(str):
    """A class or function named in a pickle, by its current name."""


class _Dtype:
    """Replacement for ``numpy.dtype``: plain numbers, text and objects only."""

    def __init__(self, text: object) -> None:
        if not isinstance(text, str) or not re.fullmatch(r"[<>|=]?[biufcSUO]\d{0,9}", text):
            raise ValueError("unsupported array type")
        self.value = np.dtype(text)


class _Array(np.ndarray):
    """An array out of a pickle; ``layout`` is that of the state that will fill it, None once it is
    filled."""

    layout: str | None = None


def _unfilled(layout: str | None = None) -> _Array:
    array = _Array((0,), np.uint8)
    array.layout = layout
    return array


# The unpickler in Python: that in C cannot be kept from instructions.
_PythonUnpickler: Any = pickle._Unpickler  # type: ignore[attr-defined]


class _Unpickler(_PythonUnpickler):
    """State of reading one pickle of ``size`` bytes from the position of ``file``."""

    def __init__(self, path: Path, file: io.BytesIO, size: int) -> None:
        super().__init__(file, encoding="latin-1")  # in which Python 2 wrote bytes
        self._path, self._file, self._size = path, file, size
        self._bytes_left = _BYTES_PER_BYTE * size + (1 << 16)
        self._sparse_entries = 0
        self._containers = 0

    def load(self) -> object:
        """Return the contents of the pickle: a tree that may share parts but never contains
        itself."""
        found = super().load()
        self._require_tree(found)
        return found

    def count(self) -> None:
        self._containers += 1
        require_at_most(self._path, self._containers, _MOST_CONTAINERS, "containers")

    def find_class(self, module: str, name: str) -> _Name:
        key = f"{module[:200]}.{name[:200]}"
        for old, new in _OLD_NAMES:
            key = re.sub(rf"\A{old}", new, key)
        if key not in _LAYOUTS and key not in _OTHER_NAMES:
            raise ValueError(f"{key!r:.80} is not supported, only numbers, text and arrays")
        return _Name(key)

    def load_put(self) -> None:
        index = int(self.readline())
        if not 0 <= index < 2 * _LARGEST_KEY:
            raise ValueError("memo index too large")
        self.memo[index] = self.stack[-1]

    def load_dict(self) -> None:
        items = self.pop_mark()
        self.append({})
        self._set_items(items)

    def load_setitem(self) -> None:
        value = self.stack.pop()
        self._set_items([self.stack.pop(), value])

    def load_setitems(self) -> None:
        self._set_items(self.pop_mark())

    def _set_items(self, items: list[Any]) -> None:
        """Put keys and values in turn into the dictionary on top."""
        target = self.stack[-1]
        if type(target) is not dict:
            raise ValueError("items set on an object that is not a dictionary")
        for key, value in zip(items[::2], items[1::2], strict=True):
            target[_checked_key(key)] = value

    def load_reduce(self) -> None:
        arguments = self.stack.pop()
        self.append(self._called(self.stack.pop(), arguments))

    def load_build(self) -> None:
        state = self.stack.pop()
        self._build(self.stack[-1], state)

    def _called(self, name: object, arguments: object) -> object:
        """Return the object that a call in the pickle constructs."""
        if not isinstance(name, _Name) or not isinstance(arguments, tuple):
            raise ValueError("call of an object that is not a function")
        if name in _LAYOUTS:
            return _unfilled(_LAYOUTS[name])
        match name, arguments:
            case "numpy.dtype", (text, *_):
                return _Dtype(text)
            case (
                "numpy.core.multiarray._reconstruct" | "copyreg._reconstructor",
                (_Name() as kind, *_),
            ) if kind in _LAYOUTS:
                return _unfilled(_LAYOUTS[kind])
            case "numpy.core.multiarray.scalar", (dtype, raw):
                return self._from_bytes(raw, dtype, (), "C")[()]
            case "numpy.core.numeric._frombuffer", (raw, dtype, shape, order):
                return self._from_bytes(raw, dtype, shape, order)
            case "numpy.core.numeric._frombuffer", (raw, dtype, shape, order, axes):
                return self._from_bytes(raw, dtype, shape, order).transpose(axes)
            case "_codecs.encode", (str() as text, "latin1" | "latin-1"):
                self._charge(len(text))
                return text.encode("latin-1")
            case "builtins.bytes", ():
                return b""
            case "collections.OrderedDict", ():
                return {}
            case "collections.OrderedDict", (list() as pairs,):
                return {_checked_key(key): value for key, value in pairs}
        raise ValueError(f"{str(name)!r:.40} is not supported, only numbers, text and arrays")

    def _build(self, target: object, state: Any) -> None:
        """Set the state of ``target``, made by ``_called``."""
        if isinstance(target, _Dtype):
            _, order, *structure = state[:5]
            if any(part is not None for part in structure):
                raise ValueError("structured arrays are not supported")
            if order in ("<", ">"):
                target.value = target.value.newbyteorder(order)
            return
        if not isinstance(target, _Array) or target.layout is None:
            raise ValueError("state set on an object without state")
        layout = target.layout
        target.layout = None
        if layout == "plain":
            self._fill(target, *(self._following(state) if isinstance(state, dict) else state)[1:])
        elif layout != "chumpy":
            self._become(target, self._dense(state, layout))
        elif isinstance(state["x"], np.ndarray):  # else it is empty
            self._become(target, _numbers(state["x"]))

    def _charge(self, count: int) -> None:
        """Count bytes that are copied; raises ValueError: too many for the size of the file."""
        self._bytes_left -= count
        if self._bytes_left < 0:
            raise ValueError("too many large arrays made from the same bytes")

    def _fill(self, target: _Array, shape: Any, dtype: object, fortran: object, raw: Any) -> None:
        if not isinstance(dtype, _Dtype):
            raise ValueError("an array has an invalid type or shape")
        is_list = dtype.value.kind == "O"
        wanted = _count(shape) * (1 if is_list else dtype.value.itemsize)
        if isinstance(raw, str):  # bytes of Python 2
            raw = raw.encode("latin-1")
        if not isinstance(raw, list if is_list else bytes) or len(raw) != wanted:
            raise ValueError("the size of an array does not match its shape")
        self._charge(8 * wanted if is_list else wanted)
        if not is_list:
            require_text(bytes(raw), dtype.value)
        # NumPy frees arrays of objects in each other by recursion.
        elif any(isinstance(x, _Array) and (x.layout or x.dtype.kind == "O") for x in raw):
            raise ValueError("arrays of objects are nested too deeply")
        target.__setstate__((1, tuple(shape), dtype.value, bool(fortran), raw))  # type: ignore[arg-type]

    def _become(self, target: _Array, array: np.ndarray) -> None:
        """Copy the numbers of another array."""
        self._charge(array.nbytes)
        target.__setstate__((1, array.shape, array.dtype, False, array.tobytes()))  # type: ignore[arg-type]

    def _following(self, state: dict[str, Any]) -> tuple[Any, ...]:
        """Return the state of an array whose bytes joblib wrote into the file after this entry."""
        shape = state["shape"]
        dtype = state["dtype"]
        if not isinstance(dtype, _Dtype) or dtype.value.kind == "O":
            raise ValueError("an array does not contain numbers")
        if state.get("numpy_array_alignment_bytes") is not None:
            self._file.read(self._file.read(1)[0])
        raw = self._file.read(min(_count(shape) * dtype.value.itemsize, self._size))
        return 1, shape, dtype, state["order"] == "F", raw

    def _dense(self, state: dict[str, Any], layout: str) -> np.ndarray:
        """Return the array of a matrix of compressed columns or rows."""
        import scipy.sparse

        shape = state["_shape"]
        entries = _count(shape)
        self._sparse_entries += entries
        require_at_most(
            self._path, self._sparse_entries, _MOST_SPARSE_ENTRIES, "entries of sparse matrices"
        )
        self._bytes_left += 8 * entries  # which are counted above
        parts = tuple(_numbers(state[name]) for name in ("data", "indices", "indptr"))
        make = scipy.sparse.csc_array if layout == "columns" else scipy.sparse.csr_array
        matrix = make(parts, shape=shape)
        matrix.check_format(full_check=True)
        return matrix.toarray().astype(np.float64)

    def _from_bytes(self, raw: object, dtype: object, shape: object, order: object) -> np.ndarray:
        if not isinstance(dtype, _Dtype) or dtype.value.kind == "O":
            raise ValueError("an array does not contain numbers")
        array = _unfilled()
        self._fill(array, shape, dtype, order == "F", raw)
        return array

    def _require_tree(self, found: object) -> None:
        """Check that walking through the contents ends soon.

        Raises:
            DyngsError: it has too many entries, shared ones counted at each occurrence.
            ValueError: it contains itself, or is nested too deeply.
        """
        most = _MOST_ENTRIES + 2 * self._size + self._sparse_entries
        weights: dict[int, int | None] = {}

        def weight(value: Any, depth: int) -> int:
            if isinstance(value, np.ndarray) and value.dtype.kind != "O":
                return 1 + value.size
            if not isinstance(value, (dict, list, tuple, np.ndarray)):
                return 1
            if id(value) not in weights:
                if depth > _DEEPEST:
                    raise ValueError("nested too deeply")
                weights[id(value)] = None
                parts = value.ravel(order="K").tolist() if isinstance(value, np.ndarray) else value
                total = 1 + sum(weight(part, depth + 1) for part in parts)
                if isinstance(value, dict):
                    total += sum(weight(part, depth + 1) for part in value.values())
                require_at_most(self._path, total, most, "entries (shared ones counted again)")
                weights[id(value)] = total
            known = weights[id(value)]
            if known is None:
                raise ValueError("it contains a reference to itself")
            return known

        weight(found, 0)


def _counted(load: Callable[[Any], None]) -> Callable[[Any], None]:
    def counting(unpickler: _Unpickler) -> None:
        unpickler.count()
        load(unpickler)

    return counting


def _loader(name: str) -> tuple[int, Callable[[Any], None]]:
    """Return the code and the method of an instruction."""
    code: int = getattr(pickle, name)[0]
    usual = _PythonUnpickler.dispatch[code]
    # NEWOBJ is a call, too, and a bytearray would be allocated before it is read
    special = {"NEWOBJ": "load_reduce", "BYTEARRAY8": "load_binbytes8"}
    method = special.get(name, str(usual.__name__))
    return code, getattr(_Unpickler, method)


_Unpickler.dispatch = dict(_loader(name) for name in _VALUES.split())
for _code, _load in map(_loader, _CONTAINERS.split()):
    _Unpickler.dispatch[_code] = _counted(_load)


def _checked_key(key: object) -> Any:
    """Return a key that can be hashed quickly; raises ValueError for others."""
    is_short = isinstance(key, (str, bytes)) and len(key) <= _LONGEST_KEY
    is_small = isinstance(key, (int, np.integer)) and abs(int(key)) < _LARGEST_KEY
    if not (is_short or is_small or key is None):
        raise ValueError(f"a dictionary key is a {type(key).__name__}, or too long")
    return key


def _count(shape: Any) -> int:
    """Return the number of entries of an array of that shape."""
    if not isinstance(shape, (tuple, list)) or len(shape) > 32:
        raise ValueError("an array has an invalid type or shape")
    if not all(isinstance(n, (int, np.integer)) and 0 <= n < 1 << 48 for n in shape):
        raise ValueError("an array has an invalid type or shape")
    return math.prod(int(n) for n in shape)


def _numbers(array: object) -> np.ndarray:
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        raise ValueError("an array does not contain numbers")
    return array
