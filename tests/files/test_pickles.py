"""Pickles: plain values, arrays of all writers, and files that are damaged or hostile."""

from __future__ import annotations

import io
import os
import pickle
import shutil
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from synthetic_bodies import write_python2_pickle

from dyngs.errors import DyngsError
from dyngs.files.pickles import read_pickle, read_pickled_array


def pickled(tmp_path: Path, content: bytes) -> Path:
    (tmp_path / "a.pkl").write_bytes(content)
    return tmp_path / "a.pkl"


ATOMS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary(min_size=1)
TREES = st.recursive(
    ATOMS, lambda tree: st.lists(tree) | st.dictionaries(st.text(), tree) | st.tuples(tree, tree), max_leaves=12
)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
    read: Any = read_pickle(pickled(tmp_path, pickle.dumps({"a": ARRAYS, "again": ARRAYS[0]}, protocol)))
    for value, expected in zip(read["a"], ARRAYS, strict=True):
        np.testing.assert_array_equal(np.asarray(value), expected)
        assert np.asarray(value).dtype.kind == np.asarray(expected).dtype.kind
    assert read["again"] is read["a"][0]


def test_pickles_of_python_2(tmp_path: Path) -> None:
    """As Python 2 wrote ``{'camera_f': numpy.array([1.5, 2.0]), 'width': 1080}`` with protocol 2."""
    numbers = np.array([1.5, -2.0]).tobytes()
    content = (
        b"\x80\x02}q\x00(U\x08camera_fq\x01cnumpy.core.multiarray\n_reconstruct\nq\x02cnumpy\nndarray\nq\x03K\x00\x85"
    )
    content += b"U\x01b\x87Rq\x04(K\x01K\x02\x85cnumpy\ndtype\nq\x05U\x02f8K\x00K\x01\x87Rq\x06(K\x03U\x01<NNN"
    content += b"J\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89U\x10" + numbers + b"tbU\x05widthM8\x04u."
    read: Any = read_pickle(pickled(tmp_path, content))
    assert (list(read["camera_f"]), read["width"]) == ([1.5, -2.0], 1080)


class Wrapper:
    """What joblib writes instead of an array; the bytes follow behind."""

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
        vars(wrapper).update(subclass=np.ndarray, shape=obj.shape, order=order, dtype=obj.dtype, allow_mmap=True)
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
def test_joblib(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, protocol: int, alignment: int | None) -> None:
    for name in ("joblib", "joblib.numpy_pickle"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setattr(sys.modules["joblib.numpy_pickle"], "NumpyArrayWrapper", Wrapper, raising=False)
    monkeypatch.setattr(JoblibPickler, "alignment", alignment)
    arrays = [np.random.default_rng(i).normal(size=(3, 5 + i)) for i in range(4)] + [np.asfortranarray(np.eye(3) + 1)]
    file = io.BytesIO()
    JoblibPickler(file, protocol).dump({1: {"pose": arrays, "n": 5}})
    read: Any = read_pickle(pickled(tmp_path, file.getvalue()))
    for value, expected in zip(read[1]["pose"], arrays, strict=True):
        np.testing.assert_array_equal(value, expected)
    assert read[1]["n"] == 5
    with pytest.raises(DyngsError, match="cannot be read as a pickle"):
        read_pickle(pickled(tmp_path, file.getvalue()[:-40]))


class Calls:
    """Pickles as a call."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.parts = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self.parts


HOSTILE = {
    "a command": Calls(os.system, "touch ran"),
    "a file": Calls(open, "ran", "w"),
    "eval": Calls(eval, "open('ran', 'w')"),
    "getattr": Calls(getattr, "text", "__class__"),
    "import": Calls(import_module, "os"),
    "numpy.load": Calls(np.load, "x.npy"),
    "a class": Rotation,
    "torch": torch.zeros(1),
    "structured": np.zeros(2, dtype=[("a", "O")]),
    "times": np.zeros(2, dtype="M8[s]"),
    "text": Calls(__import__("_codecs").encode, "uryyb", "rot13"),
    "exec": Calls(exec, "open('ran', 'w')"),
    "copy": Calls(shutil.copyfile, __file__, "ran"),
    "numpy.save": Calls(np.save, "ran", np.zeros(1)),
    "bytes": Calls(bytes, 10**15),
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_nothing_else_is_read(tmp_path: Path, name: str, protocol: int) -> None:
    path = pickled(tmp_path, pickle.dumps({"x": [HOSTILE[name]]}, protocol))
    with pytest.raises(DyngsError, match=r"a\.pkl: cannot be read as a pickle \(") as caught:
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
        b"cbuiltins\ngetattr\n(cos\nsystem\nS'x'\ntR.",
        b'cnumpy.testing._private.utils\nrunstring\n(S\'open("ran", "w")\'\n}tR.',
        b"cnumpy\nndarray.__class__\n.",
        b"\x80\x04\x8c\x05posix\x8c\x0bsys\ntem\r\x00xy\x93.",
        b"\x82\x01.",
        b"Pperson\n.",
        b"cnumpy\nndarray\n(N}S'args'\nI1\nstb.",
        b"ccopyreg\n_reconstructor\n(cbuiltins\nobject\ncbuiltins\nobject\nNtR.",
    ],
)
def test_pickles_made_by_hand(content: bytes, tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"cannot be read as a pickle \("):
        read_pickle(pickled(tmp_path, content))
    assert not Path("ran").exists()


def test_names_that_are_known_stand_for_nothing_that_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not even a module of that name that lies beside the file is imported."""
    for name in ("chumpy", "scipy/sparse", "joblib"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / f"{name}.py").write_text("open('ran', 'w')")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("chumpy\nCh", "chumpy.ch\nCh", "joblib.numpy_pickle\nNumpyArrayWrapper"):
        read_pickle(pickled(tmp_path, f"c{name}\n.".encode()))
    assert not Path("ran").exists()
    assert "chumpy" not in sys.modules


@pytest.mark.parametrize("make", [getattr(scipy.sparse, f"cs{x}_{kind}") for x in "cr" for kind in ("matrix", "array")])
@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_sparse_matrices_come_back_whole(tmp_path: Path, make: Callable[[object], object], protocol: int) -> None:
    """Entries that are there twice add up, as they do in SciPy."""
    dense = np.where(np.random.default_rng(0).uniform(size=(5, 7)) < 0.3, 2.5, 0)
    read: Any = read_pickle(pickled(tmp_path, pickle.dumps({"J": make(dense)}, protocol)))
    np.testing.assert_array_equal(read["J"], dense)
    old: Any = read_pickle(write_python2_pickle(tmp_path / "old.pkl", {"J": make(dense)}, min(protocol, 2)))
    np.testing.assert_array_equal(old["J"], dense)
    twice: Any = make(np.ones((2, 2)))
    twice.indices[:] = 1
    found: Any = read_pickle(pickled(tmp_path, pickle.dumps(twice, protocol)))
    np.testing.assert_array_equal(found, twice.toarray())


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("indices", -1),
        ("indices", 10**6),
        ("indptr", -5),
        ("indptr", 10**9),
        ("_shape", (2**31, 2**31)),
        ("_shape", (2**40, 7)),
        ("_shape", (-5, 7)),
        ("_shape", (24,)),
        ("data", None),
        ("data", np.array(["a"] * 35)),
    ],
)
def test_damaged_sparse_matrices(part: str, value: object, tmp_path: Path) -> None:
    """SciPy would read or write outside its arrays, or take any amount of memory."""
    matrix = scipy.sparse.csc_matrix(np.ones((5, 7)))
    if isinstance(value, int):
        getattr(matrix, part)[3] = value
    else:
        setattr(matrix, part, value)
    with pytest.raises(DyngsError, match=r"cannot be read as a pickle \(|asks for .* entries of sparse matrices"):
        read_pickle(pickled(tmp_path, pickle.dumps({"J": matrix}, 2)))


def array_with_state(state: tuple[Any, ...]) -> bytes:
    """A pickle of an array with a state that NumPy would not write."""

    class Crafted:
        def __reduce__(self) -> tuple[Any, ...]:
            return np.zeros(1).__reduce__()[0], (np.ndarray, (0,), b"b"), state

    return pickle.dumps(Crafted(), 4)


@pytest.mark.parametrize(
    "state",
    [
        (1, (2,), np.dtype(object), False, b"\x01" * 16),
        (1, (1 << 40,), np.dtype(float), False, b""),
        (1, (2,), np.dtype(float), False, b"\0" * 15),
        (1, (-2,), np.dtype(float), False, b""),
        (1, (2,), np.dtype(object), False, [1]),
        (1, (2.0,), np.dtype(float), False, b"\0" * 16),
        (1, (2,), "f8", False, b"\0" * 16),
        (1, (2,)),
    ],
)
def test_arrays_that_lie_about_themselves(tmp_path: Path, state: tuple[Any, ...]) -> None:
    with pytest.raises(DyngsError, match="cannot be read as a pickle"):
        read_pickle(pickled(tmp_path, array_with_state(state)))


def test_a_file_cannot_change_what_the_next_one_sees(tmp_path: Path) -> None:
    """BUILD on a class or function would set its attributes."""
    expected = np.arange(3.0)
    for name in ("numpy\nndarray", "numpy\ndtype", "numpy.core.multiarray\n_reconstruct", "_codecs\nencode"):
        with pytest.raises(DyngsError, match="cannot be read as a pickle"):
            read_pickle(pickled(tmp_path, f"c{name}\n(N}}V__defaults__\nNsV__new__\nI2\nstb.".encode()))
        for protocol in (0, 5):
            read = read_pickle(pickled(tmp_path, pickle.dumps(expected, protocol)))
            np.testing.assert_array_equal(np.asarray(read), expected)


def test_a_small_file_cannot_claim_memory(tmp_path: Path) -> None:
    """LONG_BINPUT with the largest index makes the unpickler in C allocate 64 GB."""
    assert read_pickle(pickled(tmp_path, b"Nr\xff\xff\xff\xff.")) is None


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_pickles_give_one_line(tmp_path: Path, data: st.DataObject) -> None:
    content = bytearray(pickle.dumps({"a": np.arange(3.0), "b": ["x", 1, (2.5, None)]}, data.draw(st.integers(0, 5))))
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    try:
        read_pickle(pickled(tmp_path, bytes(content)))
    except DyngsError as error:
        assert "\n" not in str(error)  # noqa: PT017


def test_pickled_arrays(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    with pytest.raises(DyngsError, match=r"a\.npy: no such file"):
        read_pickled_array(path)
    np.save(path, np.array({"K": [np.eye(3)]}, dtype=object), allow_pickle=True)
    read: Any = read_pickled_array(path)
    np.testing.assert_array_equal(read["K"][0], np.eye(3))
    for array, line in ((np.zeros(3), "Python objects was expected"), (np.array([{}, {}]), "must hold one dictionary")):
        np.save(path, array, allow_pickle=True)
        with pytest.raises(DyngsError, match=line):
            read_pickled_array(path)
    path.write_bytes(b"\x93NUMPY\x01")
    with pytest.raises(DyngsError, match="cannot be read"):
        read_pickled_array(path)
