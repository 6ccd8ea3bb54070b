"""Pickles made to crash, hang or fill memory: small files whose reading must end in one line, at a small cost."""

from __future__ import annotations

import pickle
import struct
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from measured import cost_of

from dyngs.errors import DyngsError
from dyngs.files import unpickler
from dyngs.files.pickles import read_pickle
from dyngs.files.unpickler import require_tree

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


def key_of(number: int) -> bytes:
    """A number, and None."""
    raw = number.to_bytes(number.bit_length() // 8 + 1, "little", signed=True)
    return b"\x8a" + bytes([len(raw)]) + raw + b"N"


OBJECTS = b"(I1\n(I1\ntcnumpy\ndtype\n(S'O8'\ntRI00\n(lp9\n%sat"
"""The state of an array of one object."""

HOSTILE = {
    "partial": b"ccopyreg\n_reconstructor\n(N}S'func'\nNstb.",
    "partial whose state is set": b"c_codecs\nencode\n(c_codecs\nencode\n)}NtbN.",
    "partial of partial": b"cfunctools\npartial\n.",
    "hash of a deep tuple": b"}" + b"N" + b"\x85" * 200_000 + b"Ns.",
    "hash of a deep tuple in a set": b"\x8f(" + b"N" + b"\x85" * MANY + b"\x90.",
    "hash of a doubled tuple": b"}" + doubled(60) + b"Ns.",
    "doubled tuples": doubled(60) + b".",
    "doubled tuples as text of a type": b"cnumpy\ndtype\n(" + doubled(60) + b"tR.",
    "doubled lists": b"N" + b"p1\n0(g1\ng1\nl" * 60 + b".",
    "a deep tuple": b"N" + b"\x85" * MANY + b".",
    "deep lists": b"]" * MANY + b"a" * (MANY - 1) + b".",
    "deep marks": b"(" * MANY + b"t" * MANY + b".",
    "marks": b"(" * 4 * MANY,
    "a list in itself": b"]2a.",
    "a dictionary in itself": b"}p1\nS'a'\ng1\ns.",
    "an array in itself": array(b"p1\n" + OBJECTS % b"g1\n") + b".",
    "arrays in arrays": b"N" + b"".join(b"p2\n0" + array(OBJECTS % b"g2\n") for _ in range(50)) + b".",
    "an array filled twice": b"(" + array(b"(I1\n(I0\ntcnumpy\ndtype\n(S'f8'\ntRI00\nS''\nt") + b"Nbt.",
    "bytes of 4 GB": b"\x96" + struct.pack("<Q", 1 << 32) + b".",
    "bytes of 2^63": b"\x8e" + struct.pack("<Q", 1 << 63) + b".",
    "text of 4 GB": b"X" + struct.pack("<I", (1 << 32) - 1) + b".",
    "a negative length": b"T" + struct.pack("<i", -1) + b".",
    "a frame of 2^63": b"\x95" + struct.pack("<Q", 1 << 63) + b"N",
    "a number of many digits": b"\x8b" + struct.pack("<i", MANY) + b"\xff" * MANY + b".",
    "text of many digits": b"L" + b"9" * MANY + b"\n.",
    "rows": sparse(1 << 26, 1),
    "columns": sparse(1, 1 << 26, "csr"),
    "both": sparse(1 << 13, 1 << 13),
    "numbers as keys": b"}(" + b"".join(b"J" + struct.pack("<i", i) + b"N" for i in range(70_000)) + b"u.",
    "numbers found slowly": b"}(" + b"".join(key_of(i * (2**61 - 1)) for i in range(1, 60_000)) + b"u.",
    "fractions as keys": b"}G?\xe0\0\0\0\0\0\0Ns.",
    "long keys": b"X" + struct.pack("<I", MANY) + b"a" * MANY + b"p1\n0}" + b"g1\nNs" * 9 + b".",
    "an array as a key": b"}" + array(b"(I1\n(I0\ntcnumpy\ndtype\n(S'f8'\ntRI00\nS''\nt") + b"Ns.",
    "a list as a key": b"}]Ns.",
    "many axes": array(b"(I1\n(" + b"I1\n" * 5000 + b"tcnumpy\ndtype\n(S'f8'\ntRI00\nS'12345678'\nt") + b".",
    "text that is none": array(b"(I1\n(I1\ntcnumpy\ndtype\n(S'U1'\ntRI00\nS'\\xff\\xff\\xff\\xff'\nt") + b".",
    "an empty stack": b"0.",
    "beneath a mark": b"N(0a.",
    "a mark that is not there": b"NNt.",
    "an instruction of nobody": b"\xff.",
    "a buffer from elsewhere": b"\x97.",
    "a persistent name": b"Pa\n.",
    "an extension": b"\x82\x01.",
    "a set of a list": b"c__builtin__\nset\n((lp1\n(lp2\natR.",
    "a set of a number": b"c__builtin__\nset\n(I5\ntR.",
    "quotes": b"Sabc\n.",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_pickles_cost_little_and_end_in_one_line(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.pkl"
    path.write_bytes(HOSTILE[name])

    def read() -> None:
        with pytest.raises(DyngsError, match=r"a\.pkl: (cannot be read as a pickle \(|asks for)") as caught:
            read_pickle(path)
        assert "\n" not in str(caught.value)

    memory, seconds = cost_of(read)
    assert memory < 400e6
    assert seconds < 30  # untraced they take a second at most


@pytest.mark.parametrize(("what", "step"), [("containers", b"\x8f"), ("remembered values", b"\x94")])
def test_instructions_of_one_byte_that_take_hundreds(
    tmp_path: Path, what: str, step: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("_MOST_CONTAINERS", "_MOST_REMEMBERED"):
        assert getattr(unpickler, name) == 1 << 20
        monkeypatch.setattr(unpickler, name, 1 << 12)
    (tmp_path / "a.pkl").write_bytes(b"(N" + step * (1 << 13) + b"t.")
    with pytest.raises(DyngsError, match=f"asks for 4,097 {what}, of which 4,096 are read"):
        read_pickle(tmp_path / "a.pkl")


def test_one_array_many_times(tmp_path: Path) -> None:
    """The same bytes for many arrays, and the same array in many places."""
    path = tmp_path / "a.pkl"
    raw = b"B" + struct.pack("<I", 1 << 20) + bytes(1 << 20) + b"p1\n0cnumpy\ndtype\n(S'u1'\ntRp2\n0("
    again = array(b"(I1\n(I1048576\ntg2\nI00\ng1\nt")
    path.write_bytes(raw + again * 100 + b"t.")
    with pytest.raises(DyngsError, match="many large arrays out of the same bytes"):
        read_pickle(path)
    path.write_bytes(raw + again + b"p3\n0(" + b"g3\n" * 100 + b"t.")
    with pytest.raises(DyngsError, match=r"entries .shared ones counted again"):
        read_pickle(path)
    path.write_bytes(raw + again + b"p3\n0(" + b"g3\n" * 2 + b"t.")
    found: Any = read_pickle(path)
    assert all(part is found[0] for part in found)


def test_a_variable_allows_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.pkl"
    path.write_bytes(HOSTILE["numbers as keys"])
    with pytest.raises(DyngsError, match=r"asks for 70,000 keys that are no text.* DYNGS_LIMITS=2"):
        read_pickle(path)
    monkeypatch.setenv("DYNGS_LIMITS", "2")
    found: Any = read_pickle(path)
    assert len(found) == 70_000


@pytest.mark.parametrize("protocol", range(6))
def test_what_writers_do_beside_lists_and_dictionaries(tmp_path: Path, protocol: int) -> None:
    shared = {"a": [1, 2.5]}
    tree = {
        "sets": [{1, 2}, frozenset({"a", b"b"}), set()],
        "ordered": OrderedDict([("z", 1), ("y", 2)]),
        "shared": [shared, shared],
        "numbers": [2**200, -(2**200), 0, 255, 256, -1, 2**31, 1e300, float("inf"), True, False],
        "text": ["ä€😀\n\\", "", b"\x00\xff", b"", "\udc80"],
        "keys": {None: 1, -(2**31) + 1: 2, False: 3, b"a": 4, np.int64(7): 5, np.str_("b"): 6},
    }
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(tree, protocol))
    found: Any = read_pickle(path)
    assert found == tree
    assert list(found["ordered"]) == list(tree["ordered"])
    assert found["shared"][0] is found["shared"][1]


def test_trees() -> None:
    knot: list[Any] = []
    knot.append((1, {"a": knot}))
    with pytest.raises(ValueError, match="contains itself"):
        require_tree(Path("x"), knot)
    shared = [1] * 1000
    require_tree(Path("x"), [shared] * 1000)
    with pytest.raises(DyngsError, match="x: asks for"):
        require_tree(Path("x"), [[shared] * 1000] * 1000)
