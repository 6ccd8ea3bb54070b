"""Archives of arrays: values, and files refused before memory is allocated."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from measured import cost_of

from dyngs.core.errors import DyngsError
from dyngs.io import numpy_files
from dyngs.io.numpy_files import read_arrays, read_npz


def refusal(path: Path, *names: str) -> str:
    with pytest.raises(DyngsError) as caught:
        read_arrays(path, lambda _: names)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_come_back(tmp_path: Path, save: Callable[..., None]) -> None:
    arrays = {
        "a": np.arange(6.0).reshape(2, 3),
        "b": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "c": np.array("ä"),
        "d": np.zeros((0, 3), ">f4"),
        "e": np.array([True]),
        "objects": np.array([{}], object),
    }
    save(tmp_path / "x.npz", **arrays)
    found = read_arrays(tmp_path / "x.npz", lambda names: sorted(set(names) - {"objects"}))
    assert set(found) == set("abcde")
    for name, value in found.items():
        np.testing.assert_array_equal(value, arrays[name])
        assert value.dtype == arrays[name].dtype
    assert "'objects': cannot be read (ValueError: it holds Python objects)" in refusal(
        tmp_path / "x.npz", "objects"
    )


def write_member(path: Path, shape: object, content: bytes = b"", descr: str = "<f8") -> Path:
    """Write an archive of one deflated array whose header declares ``shape``."""
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(
            "a.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + content
        )
    return path


def test_a_bomb_is_refused_before_it_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The archive directory declares the size; the limit is lowered because packing 512 MiB takes
    seconds."""
    most = 1 << 26
    monkeypatch.setattr(numpy_files, "MOST_BYTES", most)
    with (
        zipfile.ZipFile(tmp_path / "x.npz", "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("a.npy", "w") as file,
    ):
        for _ in range(most // (1 << 22) + 1):
            file.write(bytes(1 << 22))
    assert (tmp_path / "x.npz").stat().st_size < 1e6
    memory, _ = cost_of(lambda: refusal(tmp_path / "x.npz", "a"))
    assert memory < 10e6
    assert "bytes of arrays exceed the limit of 67,108,864" in refusal(tmp_path / "x.npz", "a")


@pytest.mark.parametrize(
    ("shape", "problem"),
    [
        ("(1000000000,)", "bytes of arrays"),
        ("(100000000000000000000000000, 100000000000000000)", "over 10^18 bytes of arrays"),
        ("(3,)", "does not match its shape"),
        ("(-3, -3)", "does not match its shape"),
        ("(" * 5000, "must be an array of numbers"),
        ("x" * 20000, "must be an array of numbers"),
        ("None", "must be an array of numbers"),
    ],
)
def test_headers_that_lie(tmp_path: Path, shape: str, problem: str) -> None:
    path = write_member(tmp_path / "x.npz", shape, bytes(16))
    memory, _ = cost_of(lambda: refusal(path, "a"))
    assert memory < 20e6
    assert problem in refusal(path, "a")


def test_npz(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with pytest.raises(
        DyngsError, match=r"a\.npz: no such file; it should hold the body parameters poses, trans"
    ):
        read_npz(path, ("poses", "trans"))
    np.savez(path, poses=np.zeros(3), gender="neutral")
    assert set(read_npz(path, ("poses",), ("gender", "scale"))) == {"poses", "gender"}
    with pytest.raises(DyngsError, match="'trans' is missing"):
        read_npz(path, ("poses", "trans"))
    np.savez(path, poses=np.array([{}]))
    with pytest.raises(
        DyngsError, match=r"a\.npz: 'poses': cannot be read .*it holds Python objects"
    ):
        read_npz(path, ("poses",))
    np.save(tmp_path / "b.npy", np.zeros(3))
    for damaged in (b"", b"PK\x03\x04", b"\x80\x04N.", (tmp_path / "b.npy").read_bytes()):
        path.write_bytes(damaged)
        with pytest.raises(DyngsError, match=r"a\.npz: cannot be read") as caught:
            read_npz(path, ("poses",))
        assert "\n" not in str(caught.value)
