"""Reading of pickles without executing them: numbers, text, containers, arrays of NumPy, SciPy and
chumpy.

Captures of people and body templates are distributed as pickles of Python 2 and 3, of
``numpy.save`` and of joblib. ``pickletools`` decodes the opcodes; the interpreter here knows those
for such values and none that could execute anything. A class or function named in a pickle becomes
a ``_Name``, which is only text. Time and memory are linear in the size of the file.
"""

from __future__ import annotations

import codecs
import io
import math
import pickletools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.core.errors import DyngsError, reading
from dyngs.io.fields import require_at_most
from dyngs.io.numpy_files import array_header, require_text

_MOST_ENTRIES = 1 << 20
"""Entries, shared ones counted at each occurrence, next to two per byte of the file and those of
sparse matrices. It limits containers and memo entries, too."""
_MOST_SPARSE_ENTRIES = 1 << 24
"""Entries of all sparse matrices of a file, zeros included; joint regressors of bodies have half a
million."""
_DEEPEST = 100  # containers in each other
_LONGEST_KEY = 4096
_LARGEST_KEY = 1 << 31  # a file can choose larger numbers whose hashes collide
_BYTES_PER_BYTE = 16
"""Bytes of copies per byte of the file: a reference to an object takes 8, and 2 in a pickle."""

_OPCODES = {opcode.code.encode("latin-1"): opcode for opcode in pickletools.opcodes}
_LAYOUTS = {
    "numpy.ndarray": "plain",
    "joblib.numpy_pickle.NumpyArrayWrapper": "plain",
    **{f"scipy.sparse.csc_{kind}": "columns" for kind in ("matrix", "array")},
    **{f"scipy.sparse.csr_{kind}": "rows" for kind in ("matrix", "array")},
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
)
"""Patterns of module names to the name used here: modules moved between versions."""


def read_pickle(path: Path) -> object:
    """Read a pickle of numbers, text, containers and arrays; nothing in the file is executed.

    Pickles of Python 2 and uncompressed ones of joblib are read, too. Sparse matrices of SciPy and
    arrays of chumpy become plain arrays; neither package is needed. The result never contains
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
    with reading(path, "it must be a pickle; copy it again, or export it as arrays"):
        content = path.read_bytes()
        file = io.BytesIO(content)
        if is_array and array_header(file)[2].kind != "O":
            raise ValueError("an array of Python objects was expected")
        return _Unpickler(path, file, len(content)).load()


@dataclass(frozen=True)
class _Name:
    """A class or function named in a pickle, by its current name."""

    text: str

    @property
    def layout(self) -> str | None:
        """How the state of such an object holds an array; None if it is no array."""
        return "chumpy" if self.text.startswith("chumpy.") else _LAYOUTS.get(self.text)


class _Dtype:
    """Stands for ``numpy.dtype``: plain numbers, text and objects only."""

    def __init__(self, text: object) -> None:
        if not isinstance(text, str) or not re.fullmatch(r"[<>|=]?[biufcSUO]\d{0,9}", text):
            raise ValueError("an array in it is of a type that is not read")
        self.value = np.dtype(text)


class _Array(np.ndarray):
    """An array out of a pickle; ``layout`` is that of the state that will fill it, None once it is
    filled."""

    layout: str | None = None


def _unfilled(layout: str) -> _Array:
    array = _Array((0,), np.uint8)
    array.layout = layout
    return array


class _Unpickler:
    """State of reading one pickle of ``size`` bytes from the position of ``file``."""

    def __init__(self, path: Path, file: io.BytesIO, size: int) -> None:
        self._path, self._file, self._size = path, file, size
        self._bytes_left = _BYTES_PER_BYTE * size + (1 << 16)
        self._sparse_entries = 0
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}
        self._containers = 0

    def load(self) -> object:
        """Return the contents of the pickle: a tree that may share parts but never contains
        itself."""
        while True:
            code = self._file.read(1)
            opcode = _OPCODES.get(code)
            if opcode is None:
                raise ValueError(
                    f"its instruction {code!r} is unknown" if code else "it is cut off"
                )
            if opcode.name == "STOP":
                break
            argument: Any = None
            if opcode.name == "STRING":
                raw: Any = pickletools.read_stringnl(self._file, decode=False)
                argument = codecs.escape_decode(raw)[0].decode("latin-1")  # type: ignore[attr-defined]
            elif opcode.arg is not None:
                argument = opcode.arg.reader(self._file)
            pushed = opcode.stack_after
            is_value = not opcode.stack_before and pushed not in ([], [pickletools.anyobject])
            if opcode.arg is not None and is_value:
                self._stack.append(argument)
            else:
                self._step(opcode.name, argument)
        found = self._pop()
        self._require_tree(found)
        return found

    def _step(self, name: str, argument: Any) -> None:
        match name:
            case "NONE" | "NEWTRUE" | "NEWFALSE":
                self._stack.append({"NONE": None, "NEWTRUE": True, "NEWFALSE": False}[name])
            case "EMPTY_LIST":
                self._push_container([])
            case "EMPTY_TUPLE":
                self._push_container(())
            case "EMPTY_DICT":
                self._push_container({})
            case "LIST":
                self._push_container(self._above_mark())
            case "TUPLE":
                self._push_container(tuple(self._above_mark()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                items = [self._pop() for _ in range(int(name[-1]))]
                self._push_container(tuple(items[::-1]))
            case "DICT":
                items = self._above_mark()
                self._push_container({})
                self._set_items(items)
            case "APPEND":
                self._extend([self._pop()])
            case "APPENDS":
                self._extend(self._above_mark())
            case "SETITEM":
                value = self._pop()
                self._set_items([self._pop(), value])
            case "SETITEMS":
                self._set_items(self._above_mark())
            case "MARK":
                self._marks.append(len(self._stack))
            case "POP_MARK":
                self._above_mark()
            case "POP" if self._marks and self._marks[-1] == len(self._stack):
                self._marks.pop()
            case "POP":
                self._pop()
            case "DUP":
                self._stack.append(self._top())
            case "PUT" | "BINPUT" | "LONG_BINPUT" | "MEMOIZE":
                index = len(self._memo) if argument is None else argument
                if not 0 <= index < 2 * _LARGEST_KEY:
                    raise ValueError("it remembers a value under a number that is too large")
                self._memo[index] = self._top()
                require_at_most(self._path, len(self._memo), _MOST_ENTRIES, "remembered values")
            case "GET" | "BINGET" | "LONG_BINGET":
                self._stack.append(self._memo[argument])
            case "GLOBAL":
                self._stack.append(_known_name(*argument.split(" ", 1)))
            case "STACK_GLOBAL":
                name = self._pop()
                self._stack.append(_known_name(self._pop(), name))
            case "REDUCE" | "NEWOBJ":
                arguments = self._pop()
                self._push_container(self._called(self._pop(), arguments))
            case "BUILD":
                state = self._pop()
                self._build(self._top(), state)
            case "FRAME":
                pass
            case "PROTO" if argument <= 5:
                pass
            case _:
                raise ValueError(f"its instruction {name} is not one of numbers, text and arrays")

    def _top(self) -> Any:
        if len(self._stack) <= (self._marks[-1] if self._marks else 0):
            raise ValueError("it takes from an empty stack")
        return self._stack[-1]

    def _pop(self) -> Any:
        """Pop the topmost value, which must lie above the last mark."""
        self._top()
        return self._stack.pop()

    def _above_mark(self) -> list[Any]:
        """Pop all values above the last mark."""
        start = self._marks.pop()
        items = self._stack[start:]
        del self._stack[start:]
        return items

    def _push_container(self, value: Any) -> None:
        self._containers += 1
        require_at_most(self._path, self._containers, _MOST_ENTRIES, "containers")
        self._stack.append(value)

    def _extend(self, items: list[Any]) -> None:
        target = self._top()
        if type(target) is not list:
            raise ValueError("it appends to what is no list")
        target += items

    def _set_items(self, items: list[Any]) -> None:
        """Put keys and values in turn into the dictionary on top."""
        target = self._top()
        if type(target) is not dict or len(items) % 2:
            raise ValueError("it sets items of what is no dictionary")
        for key, value in zip(items[::2], items[1::2], strict=True):
            target[_checked_key(key)] = value

    def _called(self, name: object, arguments: object) -> object:
        """Return the object that a call stands for."""
        if not isinstance(name, _Name) or not isinstance(arguments, tuple):
            raise ValueError("it calls what is no function")
        if name.layout is not None:
            return _unfilled(name.layout)
        match name.text, arguments:
            case "numpy.dtype", (text, *_):
                return _Dtype(text)
            case (
                "numpy.core.multiarray._reconstruct" | "copyreg._reconstructor",
                (_Name(layout=str() as layout), *_),
            ):
                return _unfilled(layout)
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
        raise ValueError(
            f"it makes a {name.text!r:.40}, but only numbers, text and arrays are read"
        )

    def _build(self, target: object, state: Any) -> None:
        """Set the state of ``target``, made by ``_called``."""
        if isinstance(target, _Dtype):
            _, order, *structure = state[:5]
            if any(part is not None for part in structure):
                raise ValueError("arrays with named fields are not read")
            if order in ("<", ">"):
                target.value = target.value.newbyteorder(order)
            return
        if not isinstance(target, _Array) or target.layout is None:
            raise ValueError("it sets the state of what has none")
        layout = target.layout
        target.layout = None
        if layout == "plain":
            self._fill(target, *(self._following(state) if isinstance(state, dict) else state)[1:])
        elif layout == "chumpy":  # empty where it has no numbers
            if isinstance(state["x"], np.ndarray):
                self._become(target, _numbers(state["x"]))
        else:
            height, width = state["_shape"] if layout == "columns" else reversed(state["_shape"])
            dense = self._dense(state, height, width)
            self._become(target, dense if layout == "columns" else np.ascontiguousarray(dense.T))

    def _charge(self, count: int) -> None:
        """Count bytes that are copied; raises ValueError: too many for the size of the file."""
        self._bytes_left -= count
        if self._bytes_left < 0:
            raise ValueError("it makes many large arrays out of the same bytes")

    def _fill(self, target: _Array, shape: Any, dtype: object, fortran: object, raw: Any) -> None:
        if not isinstance(dtype, _Dtype):
            raise ValueError("an array in it has no proper type and shape")
        count = _count(shape)
        is_list = dtype.value.kind == "O"
        raw = raw.encode("latin-1") if isinstance(raw, str) else raw  # bytes of Python 2
        wanted = count if is_list else count * dtype.value.itemsize
        if not isinstance(raw, list if is_list else (bytes, bytearray)) or len(raw) != wanted:
            raise ValueError("an array in it is shorter or longer than its shape")
        self._charge(8 * count if is_list else wanted)
        if is_list:
            # NumPy frees arrays of objects in each other by recursion.
            inner = [item for item in raw if isinstance(item, _Array)]
            if any(item.layout is not None or item.dtype.kind == "O" for item in inner):
                raise ValueError("arrays in it lie too deep in each other")
        else:
            raw = bytes(raw)
            require_text(raw, dtype.value)
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
            raise ValueError("an array in it does not hold numbers")
        if state.get("numpy_array_alignment_bytes") is not None:
            self._file.read(self._file.read(1)[0])
        raw = self._file.read(min(_count(shape) * dtype.value.itemsize, self._size))
        return 1, shape, dtype, state["order"] == "F", raw

    def _dense(self, state: dict[str, Any], height: Any, width: Any) -> np.ndarray:
        """Return the dense (height, width) array of a matrix of compressed columns."""
        data, row, pointers = (_numbers(state[name]) for name in ("data", "indices", "indptr"))
        entries = _count((height, width))
        self._sparse_entries += entries
        require_at_most(
            self._path, self._sparse_entries, _MOST_SPARSE_ENTRIES, "entries of sparse matrices"
        )
        counts = np.diff(pointers.astype(np.int64))
        fits = data.ndim == row.ndim == pointers.ndim == 1 and len(pointers) == width + 1
        if (
            not fits
            or not len(data) == len(row) == counts.sum()
            or row.dtype.kind not in "iu"
            or counts.min(initial=0) < 0
            or ((row < 0) | (row >= height)).any()
        ):
            raise ValueError("a sparse matrix in it is damaged")
        self._bytes_left += 8 * entries  # which are counted above
        dense = np.zeros((height, width))
        np.add.at(dense, (row, np.repeat(np.arange(width), counts)), data)
        return dense

    def _from_bytes(self, raw: object, dtype: object, shape: object, order: object) -> np.ndarray:
        if not isinstance(dtype, _Dtype) or dtype.value.kind == "O":
            raise ValueError("an array in it does not hold numbers")
        array = _Array((0,), np.uint8)
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
                    raise ValueError("it is nested too deeply")
                weights[id(value)] = None
                parts = value.ravel(order="K").tolist() if isinstance(value, np.ndarray) else value
                total = 1 + sum(weight(part, depth + 1) for part in parts)
                if isinstance(value, dict):
                    total += sum(weight(part, depth + 1) for part in value.values())
                require_at_most(self._path, total, most, "entries (shared ones counted again)")
                weights[id(value)] = total
            known = weights[id(value)]
            if known is None:
                raise ValueError("it contains itself")
            return known

        weight(found, 0)


def _known_name(module: object, name: object) -> _Name:
    """Return the name ``module.name``; raises ValueError for unknown ones."""
    if not isinstance(module, str) or not isinstance(name, str):
        raise ValueError("a class in it has no proper name")
    key = f"{module[:200]}.{name[:200]}"
    for old, new in _OLD_NAMES:
        key = re.sub(rf"\A{old}", new, key)
    found = _Name(key)
    if found.layout is None and key not in _OTHER_NAMES:
        raise ValueError(f"it holds {key!r:.80}, but only numbers, text and arrays are read")
    return found


def _checked_key(key: object) -> Any:
    """Return a key that can be hashed quickly; raises ValueError for others."""
    is_short = isinstance(key, (str, bytes)) and len(key) <= _LONGEST_KEY
    is_small = isinstance(key, (int, np.integer)) and abs(int(key)) < _LARGEST_KEY
    if not (is_short or is_small or key is None):
        raise ValueError(f"a key in it is a {type(key).__name__}, or too long")
    return key


def _count(shape: Any) -> int:
    """Return the number of entries of an array of that shape."""
    if not isinstance(shape, (tuple, list)) or len(shape) > 32:
        raise ValueError("an array in it has no proper type and shape")
    if not all(isinstance(n, (int, np.integer)) and 0 <= n < 1 << 48 for n in shape):
        raise ValueError("an array in it has no proper type and shape")
    return math.prod(int(n) for n in shape)


def _numbers(array: object) -> np.ndarray:
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        raise ValueError("an array in it does not hold numbers")
    return array
