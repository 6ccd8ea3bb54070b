"""Reading of pickles without executing them: numbers, text, containers, arrays of NumPy, SciPy and
chumpy.

Captures of people and body templates are distributed as pickles of Python 2 and 3, of
``numpy.save`` and of joblib. The interpreter here knows the opcodes for such values (protocols 0 to
5) and none that could execute anything. Names of classes and functions are only looked up in
``pickled_arrays``. Time and memory are linear in the size of the file: reads never go beyond its
end, and containers, keys and nesting are limited.
"""

from __future__ import annotations

import codecs
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.io.limits import require_at_most
from dyngs.io.pickled_arrays import ORDERED, Array, Arrays, Name

_MOST_CONTAINERS = 1 << 20
_MOST_REMEMBERED = 1 << 20
_MOST_NUMBER_KEYS = 1 << 16
_LARGEST_KEY = 1 << 31
"""Limit of keys that are numbers: a file can choose large ones whose hashes collide."""
_MOST_ENTRIES = 1 << 20
"""Entries, shared ones counted at each occurrence, next to two per byte of the file and those of
sparse matrices."""
_DEEPEST = 100
_LONGEST_KEY = 4096
_LONGEST_LINE = 1000
"""Characters of a number or a name written as text."""
_MOST_MARKS = 1000


def read_pickle(path: Path) -> object:
    """Read a pickle of numbers, text, containers and arrays; nothing in the file is executed.

    Pickles of Python 2 and uncompressed ones of joblib are read, too. Sparse matrices of SciPy and
    arrays of chumpy become plain arrays; neither package is needed. The result never contains
    itself and is at most 100 containers deep. With shared parts counted at each occurrence, it has
    at most two entries per byte of the file and a million more, next to those of sparse matrices
    (``dyngs.io.limits``).

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
    try:
        with path.open("rb") as file:
            if is_array:
                _skip_array_header(file)
            return Unpickler(path, file, path.stat().st_size).load()
    except DyngsError:
        raise
    except Exception as error:  # a damaged pickle raises nearly anything
        why = " ".join(str(error).split())[:100] or type(error).__name__
        raise DyngsError(
            f"{path}: cannot be read as a pickle ({why}); copy it again, or export it as arrays"
        ) from error


def _skip_array_header(file: BinaryIO) -> None:
    version = np.lib.format.read_magic(file)
    read = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    if read(file)[2].kind != "O":
        raise ValueError("an array of Python objects was expected")


class Unpickler:
    """State of reading one pickle from the position of ``file``."""

    def __init__(self, path: Path, file: BinaryIO, size: int) -> None:
        self._path, self._file, self._size = path, file, size
        self._left = size - file.tell()
        self._arrays = Arrays(path, size, self.read)
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[str, Any] = {}
        self._containers = self._number_keys = 0

    def load(self) -> object:
        """Return the contents of the pickle: a tree that may share parts but never contains
        itself."""
        while (code := self.read(1)) != b".":
            step = _STEPS.get(code)
            if step is None:
                raise ValueError(f"its instruction {code!r} is not one of numbers, text and arrays")
            step(self)
        found = self.pop()
        require_tree(self._path, found, 2 * self._size + self._arrays.sparse_entries)
        return found

    def read(self, count: int) -> bytes:
        """Read the next bytes; raises ValueError at the end of the file."""
        if not 0 <= count <= self._left:
            raise ValueError("it is cut off")
        self._left -= count
        return self._file.read(count)

    def number(self, layout: str) -> Any:
        """Read the next number; ``layout`` as in ``struct``."""
        return struct.unpack(layout, self.read(struct.calcsize(layout)))[0]

    def line(self, most: int | None = None) -> bytes:
        """Read the rest of this line of text."""
        found = self._file.readline(-1 if most is None else most)
        self._left -= len(found)
        if not found.endswith(b"\n"):
            raise ValueError("it is cut off, or a line of it too long")
        return found[:-1]

    def word(self) -> str:
        """Read a line that is a number or a name."""
        return self.line(_LONGEST_LINE).decode("utf-8")

    def push(self, value: object) -> None:
        self._stack.append(value)

    def pop(self) -> Any:
        """Pop the topmost value, which must lie above the last mark."""
        self._require(1)
        return self._stack.pop()

    def top(self) -> Any:
        self._require(1)
        return self._stack[-1]

    def mark(self) -> None:
        if len(self._marks) >= _MOST_MARKS:
            raise ValueError("it is nested too deeply")
        self._marks.append(len(self._stack))

    def above_mark(self) -> list[Any]:
        """Pop all values above the last mark."""
        start = self._marks.pop()
        items = self._stack[start:]
        del self._stack[start:]
        return items

    def pop_or_unmark(self) -> None:
        """Pop the topmost value, or the mark that lies there."""
        if self._marks and self._marks[-1] == len(self._stack):
            self._marks.pop()
        else:
            self.pop()

    def _require(self, count: int) -> None:
        if len(self._stack) - (self._marks[-1] if self._marks else 0) < count:
            raise ValueError("it takes from an empty stack")

    def remember(self, index: int) -> None:
        """Store the topmost value in the memo under a number."""
        require_at_most(self._path, len(self._memo) + 1, _MOST_REMEMBERED, "remembered values")
        self._memo[str(index)] = self.top()  # text: a file can choose numbers whose hashes collide

    def recall(self, index: int) -> None:
        """Push the memo's value of that number."""
        self.push(self._memo[str(index)])

    def push_container(self, value: Any) -> None:
        self._containers += 1
        require_at_most(self._path, self._containers, _MOST_CONTAINERS, "containers")
        self.push(value)

    def push_tuple(self, count: int) -> None:
        """Replace the topmost values by a tuple of them."""
        self._require(count)
        items = tuple(self._stack[-count:])
        del self._stack[-count:]
        self.push_container(items)

    def extend(self, items: list[Any]) -> None:
        """Append to the list on top."""
        target = self.top()
        if type(target) is not list:
            raise ValueError("it appends to what is no list")
        target += items

    def set_items(self, items: list[Any]) -> None:
        """Put keys and values in turn into the dictionary on top."""
        target = self.top()
        if type(target) is not dict or len(items) % 2:
            raise ValueError("it sets items of what is no dictionary")
        target.update(zip(self.checked_keys(items[::2]), items[1::2], strict=True))

    def checked_keys(self, keys: list[Any]) -> list[Any]:
        """Return the keys if all can be hashed quickly; raises ValueError otherwise."""
        for key in keys:
            if not isinstance(key, (str, bytes)):
                self._number_keys += 1
            if not _is_key(key):
                raise ValueError(f"a key in it is a {type(key).__name__}, or too long")
        require_at_most(self._path, self._number_keys, _MOST_NUMBER_KEYS, "keys that are no text")
        return keys

    def call(self, name: object, arguments: object) -> None:
        """Push the object that a call stands for."""
        if not isinstance(name, Name) or name.text != ORDERED:
            self.push_container(self._arrays.called(name, arguments))
            return
        (items,) = arguments if arguments else ((),)  # type: ignore[misc]
        if not isinstance(items, (list, tuple)):
            raise ValueError("a container in it is made of what is no list")
        pairs = [(key, value) for key, value in items]
        keys = self.checked_keys([key for key, _ in pairs])
        self.push_container(dict(zip(keys, (value for _, value in pairs), strict=True)))

    def call_top(self) -> None:
        """REDUCE and NEWOBJ: the arguments are on top, the callee below."""
        arguments = self.pop()
        self.call(self.pop(), arguments)

    def name(self) -> None:
        """GLOBAL."""
        self.push(self._arrays.named(self.word(), self.word()))

    def name_of_top(self) -> None:
        """STACK_GLOBAL."""
        name = self.pop()
        self.push(self._arrays.named(self.pop(), name))

    def build(self) -> None:
        """BUILD: the state is on top, its object below."""
        state = self.pop()
        self._arrays.build(self.top(), state)

    def check_protocol(self) -> None:
        """PROTO."""
        if (protocol := self.read(1)[0]) > 5:
            raise ValueError(f"it is of protocol {protocol}, not 0 to 5")


def require_tree(where: Path, found: object, more: int = 0) -> None:
    """Check that walking through the contents of a file ends soon; ``more`` than the usual number
    of entries may be.

    Raises:
        DyngsError: it has too many entries, shared ones counted at each occurrence.
        ValueError: it contains itself, or is nested too deeply.
    """
    weights: dict[int, int] = {}
    path: list[tuple[object, list[Any]]] = [(None, [found])]
    open_ids: set[int] = set()
    while path:
        owner, waiting = path[-1]
        if waiting:
            value = waiting.pop()
            if id(value) in weights:
                continue
            inside = _items(value)
            if inside is None:
                continue
            if id(value) in open_ids or len(path) > _DEEPEST:
                raise ValueError(
                    "it contains itself" if id(value) in open_ids else "it is nested too deeply"
                )
            open_ids.add(id(value))
            path.append((value, list(inside)))
            continue
        path.pop()
        if path:
            open_ids.discard(id(owner))
            weights[id(owner)] = 1 + sum(_weight(part, weights) for part in _items(owner) or ())
            require_at_most(
                where,
                max(weights[id(owner)] - more, 0),
                _MOST_ENTRIES,
                "entries (shared ones counted again)",
            )


def _items(value: Any) -> list[Any] | None:
    if isinstance(value, dict):
        return [*value.keys(), *value.values()]
    if isinstance(value, (list, tuple)):
        return list(value)
    return (
        value.ravel(order="K").tolist()
        if isinstance(value, Array) and value.dtype.kind == "O"
        else None
    )


def _weight(part: object, weights: dict[int, int]) -> int:
    if isinstance(part, np.ndarray) and part.dtype.kind != "O":
        return 1 + part.size
    return weights.get(id(part), 1)


def _is_key(key: object) -> bool:
    if isinstance(key, (str, bytes)):
        return len(key) <= _LONGEST_KEY
    return key is None or (isinstance(key, (int, np.integer)) and abs(int(key)) < _LARGEST_KEY)


# --- values
# -----------------------------------------------------------------------------------------------------------


def _integer(text: str) -> int | bool:
    return {"00": False, "01": True}[text] if text in ("00", "01") else int(text)


def _old_text(raw: bytes) -> str:
    """Decode a quoted string of Python 2."""
    if len(raw) < 2 or raw[:1] != raw[-1:] or raw[:1] not in b"'\"":
        raise ValueError("a text in it has no quotes")
    return codecs.escape_decode(raw[1:-1])[0].decode("latin-1")  # type: ignore[attr-defined]


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", "surrogatepass")


def _little(raw: bytes) -> int:
    if len(raw) > 255:
        raise ValueError("a number in it has too many digits")
    return int.from_bytes(raw, "little", signed=True)


def _sized(layout: str, become: Callable[[bytes], object] = bytes) -> Callable[[Unpickler], None]:
    """Return a step that pushes bytes that follow their length."""
    return lambda unpickler: unpickler.push(become(unpickler.read(unpickler.number(layout))))


def _number(layout: str) -> Callable[[Unpickler], None]:
    return lambda unpickler: unpickler.push(unpickler.number(layout))


def _word(become: Callable[[str], object]) -> Callable[[Unpickler], None]:
    return lambda unpickler: unpickler.push(become(unpickler.word()))


def _container(become: Callable[[list[Any]], object]) -> Callable[[Unpickler], None]:
    return lambda unpickler: unpickler.push_container(become(unpickler.above_mark()))


def _set_pairs(unpickler: Unpickler) -> None:
    """DICT: push a dictionary of the values above the mark."""
    items = unpickler.above_mark()
    unpickler.push_container({})
    unpickler.set_items(items)


def _set_item(unpickler: Unpickler) -> None:
    value = unpickler.pop()
    unpickler.set_items([unpickler.pop(), value])


_STEPS: dict[bytes, Callable[[Unpickler], object]] = {
    b"N": lambda m: m.push(None),
    b"\x88": lambda m: m.push(True),
    b"\x89": lambda m: m.push(False),
    b"K": _number("<B"),
    b"M": _number("<H"),
    b"J": _number("<i"),
    b"G": _number(">d"),
    b"\x8a": _sized("<B", _little),
    b"\x8b": _sized("<i", _little),
    b"I": _word(_integer),
    b"L": _word(lambda text: int(text.removesuffix("L"))),
    b"F": _word(float),
    b"S": lambda m: m.push(_old_text(m.line())),
    b"U": _sized("<B", lambda raw: raw.decode("latin-1")),
    b"T": _sized("<i", lambda raw: raw.decode("latin-1")),
    b"V": lambda m: m.push(m.line().decode("raw-unicode-escape")),
    b"\x8c": _sized("<B", _text),
    b"X": _sized("<I", _text),
    b"\x8d": _sized("<Q", _text),
    b"C": _sized("<B"),
    b"B": _sized("<I"),
    b"\x8e": _sized("<Q"),
    b"\x96": _sized("<Q", bytearray),
    b"]": lambda m: m.push_container([]),
    b"}": lambda m: m.push_container({}),
    b")": lambda m: m.push(()),
    b"(": Unpickler.mark,
    b"0": Unpickler.pop_or_unmark,
    b"1": Unpickler.above_mark,
    b"2": lambda m: m.push(m.top()),
    b"t": _container(tuple),
    b"\x85": lambda m: m.push_tuple(1),
    b"\x86": lambda m: m.push_tuple(2),
    b"\x87": lambda m: m.push_tuple(3),
    b"l": _container(list),
    b"d": _set_pairs,
    b"a": lambda m: m.extend([m.pop()]),
    b"e": lambda m: m.extend(m.above_mark()),
    b"s": _set_item,
    b"u": lambda m: m.set_items(m.above_mark()),
    b"p": lambda m: m.remember(int(m.word())),
    b"q": lambda m: m.remember(m.number("<B")),
    b"r": lambda m: m.remember(m.number("<I")),
    b"\x94": lambda m: m.remember(len(m._memo)),
    b"g": lambda m: m.recall(int(m.word())),
    b"h": lambda m: m.recall(m.number("<B")),
    b"j": lambda m: m.recall(m.number("<I")),
    b"c": Unpickler.name,
    b"\x93": Unpickler.name_of_top,
    b"R": Unpickler.call_top,
    b"\x81": Unpickler.call_top,
    b"b": Unpickler.build,
    b"\x80": Unpickler.check_protocol,
    b"\x95": lambda m: m.read(8),
}
"""The action of each opcode."""
