"""Pickles: plain values, arrays of all writers, and files that are damaged, hostile, or made to
fill memory."""

from __future__ import annotations

import io
import os
import pickle
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from measured import cost_of
from synthetic_bodies import write_python2_pickle

from dyngs.core.errors import DyngsError
from dyngs.io import pickles
from dyngs.io.pickles import read_pickle, read_pickled_array


def pickled(tmp_path: Path, content: bytes) -> Path:
    (tmp_path / "a.pkl").write_bytes(content)
    return tmp_path / "a.pkl"


ATOMS = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text()
    | st.binary(min_size=1)
)
TREES = st.recursive(
    ATOMS,
    lambda tree: st.lists(tree) | st.dictionaries(st.text(), tree) | st.tuples(tree, tree),
    max_leaves=12,
)


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(TREES, st.integers(0, 5))
def test_plain_values_come_back(tmp_path: Path, tree: object, protocol: int) -> None:
    assert read_pickle(pickled(tmp_path, pickle.dumps(tree, protocol))) == tree


ARRAYS = (
    np.arange(6.0).reshape(2, 3),
    np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    np.arange(12, dtype=np.int16)[::2],
    np.arange(3, dtype=">i4"),
    np.array([True, False]),
    np.array(7.5),
    np.array(["ab", "c"]),
    np.array([[1, None], ["x", 2.5]], dtype=object),
    np.float32(2.5),
    np.int64(-3),
)


@pytest.mark.parametrize("protocol", range(6))
def test_arrays_come_back(tmp_path: Path, protocol: int) -> None:
    read: Any = read_pickle(
        pickled(tmp_path, pickle.dumps({"a": ARRAYS, "again": ARRAYS[0]}, protocol))
    )
    for value, expected in zip(read["a"], ARRAYS, strict=True):
        np.testing.assert_array_equal(np.asarray(value), expected)
        assert np.asarray(value).dtype.kind == np.asarray(expected).dtype.kind
    assert read["again"] is read["a"][0]


def test_pickles_of_python_2(tmp_path: Path) -> None:
    """Protocol 2 bytes of Python 2 for ``{'camera_f': numpy.array([1.5, 2.0]), 'width': 1080}``."""
    numbers = np.array([1.5, -2.0]).tobytes()
    content = (
        b"\x80\x02}q\x00(U\x08camera_fq\x01cnumpy.core.multiarray\n_reconstruct\n"
        b"q\x02cnumpy\nndarray\nq\x03K\x00\x85"
    )
    content += (
        b"U\x01b\x87Rq\x04(K\x01K\x02\x85cnumpy\ndtype\n"
        b"q\x05U\x02f8K\x00K\x01\x87Rq\x06(K\x03U\x01<NNN"
    )
    content += (
        b"J\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89U\x10" + numbers + b"tbU\x05widthM8\x04u."
    )
    read: Any = read_pickle(pickled(tmp_path, content))
    assert (list(read["camera_f"]), read["width"]) == ([1.5, -2.0], 1080)


class Wrapper:
    """Placeholder that joblib writes for an array; the bytes of the array follow it."""

    __module__, __qualname__ = "joblib.numpy_pickle", "NumpyArrayWrapper"


PythonPickler: Any = pickle._Pickler  # type: ignore[attr-defined]


class JoblibPickler(PythonPickler):
    """Writes the layout of ``joblib.dump`` without compression."""

    alignment: int | None = 16

    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        if not isinstance(obj, np.ndarray):
            super().save(obj, save_persistent_id)
            return
        wrapper = Wrapper()
        order = "F" if obj.flags.f_contiguous and not obj.flags.c_contiguous else "C"
        vars(wrapper).update(
            subclass=np.ndarray, shape=obj.shape, order=order, dtype=obj.dtype, allow_mmap=True
        )
        if self.alignment:
            vars(wrapper)["numpy_array_alignment_bytes"] = self.alignment
        self.kept = [*getattr(self, "kept", []), wrapper]  # memo goes by id
        super().save(wrapper, save_persistent_id)
        if self.proto >= 4:
            self.framer.commit_frame(force=True)
        file = self.framer.file_write.__self__
        if self.alignment:
            padding = self.alignment - (file.tell() + 1) % self.alignment
            file.write(bytes([padding]) + b"\xff" * padding)
        file.write(obj.tobytes(order))


@pytest.mark.parametrize("protocol", [2, 4])
@pytest.mark.parametrize("alignment", [None, 16])
def test_joblib(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, protocol: int, alignment: int | None
) -> None:
    for name in ("joblib", "joblib.numpy_pickle"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setattr(
        sys.modules["joblib.numpy_pickle"], "NumpyArrayWrapper", Wrapper, raising=False
    )
    monkeypatch.setattr(JoblibPickler, "alignment", alignment)
    arrays = [np.random.default_rng(i).normal(size=(3, 5 + i)) for i in range(4)] + [
        np.asfortranarray(np.eye(3) + 1)
    ]
    file = io.BytesIO()
    JoblibPickler(file, protocol).dump({1: {"pose": arrays, "n": 5}})
    read: Any = read_pickle(pickled(tmp_path, file.getvalue()))
    for value, expected in zip(read[1]["pose"], arrays, strict=True):
        np.testing.assert_array_equal(value, expected)
    assert read[1]["n"] == 5
    with pytest.raises(DyngsError, match="cannot be read"):
        read_pickle(pickled(tmp_path, file.getvalue()[:-40]))


class Calls:
    """Pickles as a call."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.parts = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self.parts


HOSTILE = {
    "a command": Calls(os.system, "touch ran"),
    "eval": Calls(eval, "open('ran', 'w')"),
    "getattr": Calls(getattr, "text", "__class__"),
    "numpy.load": Calls(np.load, "x.npy"),
    "structured": np.zeros(2, dtype=[("a", "O")]),
    "text": Calls(__import__("_codecs").encode, "uryyb", "rot13"),
    "bytes": Calls(bytes, 10**15),
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_nothing_else_is_read(tmp_path: Path, name: str, protocol: int) -> None:
    path = pickled(tmp_path, pickle.dumps({"x": [HOSTILE[name]]}, protocol))
    with pytest.raises(DyngsError, match=r"a\.pkl: cannot be read \(") as caught:
        read_pickle(path)
    assert "\n" not in str(caught.value)
    np.save(tmp_path / "a.npy", np.array({"x": HOSTILE[name]}, dtype=object), allow_pickle=True)
    with pytest.raises(DyngsError, match=r"a\.npy: cannot be read"):
        read_pickled_array(tmp_path / "a.npy")
    assert not Path("ran").exists()


@pytest.mark.parametrize(
    "content",
    [
        b"cos\nsystem\n(S'touch ran'\ntR.",
        b"(S'touch ran'\nios\nsystem\n.",
        b'cnumpy.testing._private.utils\nrunstring\n(S\'open("ran", "w")\'\n}tR.',
        b"cnumpy\nndarray.__class__\n.",
        b"\x80\x04\x8c\x05posix\x8c\x0bsys\ntem\r\x00xy\x93.",
        b"\x82\x01.",
        b"Pperson\n.",
        b"0.",
        b"NNt.",
        b"\xff.",
        b"Sabc\n.",
        b"T\xff\xff\xff\xff.",
        b"}G?\xe0\0\0\0\0\0\0Ns.",
        b"cnumpy\nndarray\n(N}S'args'\nI1\nstb.",
        b"ccopyreg\n_reconstructor\n(cbuiltins\nobject\ncbuiltins\nobject\nNtR.",
    ],
)
def test_pickles_made_by_hand(content: bytes, tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"cannot be read \("):
        read_pickle(pickled(tmp_path, content))
    assert not Path("ran").exists()


@pytest.mark.parametrize(
    "make", [getattr(scipy.sparse, f"cs{x}_{kind}") for x in "cr" for kind in ("matrix", "array")]
)
@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_sparse_matrices_come_back_whole(
    tmp_path: Path, make: Callable[[object], object], protocol: int
) -> None:
    """Duplicate entries are summed, as in SciPy."""
    dense = np.where(np.random.default_rng(0).uniform(size=(5, 7)) < 0.3, 2.5, 0)
    read: Any = read_pickle(pickled(tmp_path, pickle.dumps({"J": make(dense)}, protocol)))
    np.testing.assert_array_equal(read["J"], dense)
    old: Any = read_pickle(
        write_python2_pickle(tmp_path / "old.pkl", {"J": make(dense)}, min(protocol, 2))
    )
    np.testing.assert_array_equal(old["J"], dense)
    twice: Any = make(np.ones((2, 2)))
    twice.indices[:] = 1
    found: Any = read_pickle(pickled(tmp_path, pickle.dumps(twice, protocol)))
    np.testing.assert_array_equal(found, twice.toarray())


def test_instructions_that_could_run_code_are_unknown() -> None:
    """Calls and imports go to methods of our own, and all others of that kind are left out."""
    known = pickles._Unpickler.dispatch
    for name in [
        "INST",
        "OBJ",
        "NEWOBJ_EX",
        "EXT1",
        "EXT2",
        "EXT4",
        "PERSID",
        "BINPERSID",
        "NEXT_BUFFER",
        "READONLY_BUFFER",
    ]:
        assert getattr(pickle, name)[0] not in known
    own = vars(pickles._Unpickler)
    assert {"find_class", "load_reduce", "load_build"} <= own.keys()
    for name in ("REDUCE", "NEWOBJ", "BUILD"):
        step = known[getattr(pickle, name)[0]]
        assert step.__module__ == pickles.__name__


def test_a_file_cannot_change_what_the_next_one_sees(tmp_path: Path) -> None:
    """BUILD on a class or function would set its attributes."""
    expected = np.arange(3.0)
    for name in (
        "numpy\nndarray",
        "numpy\ndtype",
        "numpy.core.multiarray\n_reconstruct",
        "_codecs\nencode",
    ):
        with pytest.raises(DyngsError, match="cannot be read"):
            read_pickle(
                pickled(tmp_path, f"c{name}\n(N}}V__defaults__\nNsV__new__\nI2\nstb.".encode())
            )
        for protocol in (0, 5):
            read = read_pickle(pickled(tmp_path, pickle.dumps(expected, protocol)))
            np.testing.assert_array_equal(np.asarray(read), expected)


def test_pickled_arrays(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    with pytest.raises(DyngsError, match=r"a\.npy: no such file"):
        read_pickled_array(path)
    np.save(path, np.array({"K": [np.eye(3)]}, dtype=object), allow_pickle=True)
    read: Any = read_pickled_array(path)
    np.testing.assert_array_equal(read["K"][0], np.eye(3))
    for array, line in (
        (np.zeros(3), "expected an array of Python objects"),
        (np.array([{}, {}]), "must hold one dictionary"),
    ):
        np.save(path, array, allow_pickle=True)
        with pytest.raises(DyngsError, match=line):
            read_pickled_array(path)
    path.write_bytes(b"\x93NUMPY\x01")
    with pytest.raises(DyngsError, match="cannot be read"):
        read_pickled_array(path)


# --- small files whose reading must end in one line, at a small cost ---

MANY = 50_000


def doubled(times: int, last: bytes = b"N") -> bytes:
    """A tuple of itself twice, and so on: 2^times entries in 4 bytes each."""
    return last + b"2\x86" * times


def sparse(rows: int, columns: int, kind: str = "csc") -> bytes:
    """A pickle of an empty matrix."""
    matrix: Any = getattr(scipy.sparse, f"{kind}_matrix")((1, 1))
    matrix._shape = (rows, columns)
    matrix.indptr = np.zeros((columns if kind == "csc" else rows) + 1, dtype=np.int8)
    return pickle.dumps({"J": matrix}, 2)


def array(state: bytes) -> bytes:
    """An array of which ``state`` is what BUILD takes."""
    return b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR" + state + b"b"


OBJECTS = b"(I1\n(I1\ntcnumpy\ndtype\n(S'O8'\ntRI00\n(lp9\n%sat"
"""The state of an array of one object."""

OVERSIZED = {
    "partial": b"ccopyreg\n_reconstructor\n(N}S'func'\nNstb.",
    "hash of a deep tuple": b"}" + b"N" + b"\x85" * 200_000 + b"Ns.",
    "doubled tuples": doubled(60) + b".",
    "doubled lists": b"N" + b"p1\n0(g1\ng1\nl" * 60 + b".",
    "a deep tuple": b"N" + b"\x85" * MANY + b".",
    "deep marks": b"(" * MANY + b"t" * MANY + b".",
    "a list in itself": b"]2a.",
    "an array in itself": array(b"p1\n" + OBJECTS % b"g1\n") + b".",
    "arrays in arrays": b"N"
    + b"".join(b"p2\n0" + array(OBJECTS % b"g2\n") for _ in range(50))
    + b".",
    "bytes of 4 GB": b"\x96" + struct.pack("<Q", 1 << 32) + b".",
    "a frame of 2^63": b"\x95" + struct.pack("<Q", 1 << 63) + b"N",
    "rows": sparse(1 << 26, 1),
    "a large number as a key": b"}\x8a\x05\0\0\0\0\x01Ns.",
    "many axes": array(
        b"(I1\n(" + b"I1\n" * 5000 + b"tcnumpy\ndtype\n(S'f8'\ntRI00\nS'12345678'\nt"
    )
    + b".",
    "text that is none": array(
        b"(I1\n(I1\ntcnumpy\ndtype\n(S'U1'\ntRI00\nS'\\xff\\xff\\xff\\xff'\nt"
    )
    + b".",
    "beneath a mark": b"N(0a.",
    "a buffer from elsewhere": b"\x97.",
    "a set of a list": b"c__builtin__\nset\n((lp1\n(lp2\natR.",
}


@pytest.mark.parametrize("name", OVERSIZED)
def test_hostile_pickles_cost_little_and_end_in_one_line(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.pkl"
    path.write_bytes(OVERSIZED[name])

    def read() -> None:
        with pytest.raises(
            DyngsError, match=r"a\.pkl: (cannot be read \(|.* exceed the limit)"
        ) as caught:
            read_pickle(path)
        assert "\n" not in str(caught.value)

    memory, seconds = cost_of(read)
    assert memory < 400e6
    assert seconds < 30  # untraced they take a second at most


def test_one_array_many_times(tmp_path: Path) -> None:
    """The same bytes for many arrays, and the same array in many places."""
    path = tmp_path / "a.pkl"
    raw = (
        b"B" + struct.pack("<I", 1 << 20) + bytes(1 << 20) + b"p1\n0cnumpy\ndtype\n(S'u1'\ntRp2\n0("
    )
    again = array(b"(I1\n(I1048576\ntg2\nI00\ng1\nt")
    path.write_bytes(raw + again * 100 + b"t.")
    with pytest.raises(DyngsError, match="many large arrays made from the same bytes"):
        read_pickle(path)
    path.write_bytes(raw + again + b"p3\n0(" + b"g3\n" * 100 + b"t.")
    with pytest.raises(DyngsError, match=r"entries .shared ones counted again"):
        read_pickle(path)
    path.write_bytes(raw + again + b"p3\n0(" + b"g3\n" * 2 + b"t.")
    found: Any = read_pickle(path)
    assert all(part is found[0] for part in found)
