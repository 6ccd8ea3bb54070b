"""Data sets of HDF5 files, damaged and hostile ones among them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dyngs.core.errors import DyngsError
from dyngs.io.hdf5 import hdf5_length, read_hdf5


@pytest.fixture
def hdf5(tmp_path: Path) -> Path:
    h5py = pytest.importorskip("h5py", reason="needs dyngs[people]")
    with h5py.File(tmp_path / "m.hdf5", "w") as file:
        masks = np.zeros((5, 2, 3), np.uint8)
        masks[3, 1, 2] = 1
        file.create_dataset("masks", data=masks, compression="lzf")
        file.create_dataset("deep", data=np.zeros((2, 2, 3)))
        file.create_group("group")
    return tmp_path / "m.hdf5"


def test_data_sets_and_their_lengths(hdf5: Path) -> None:
    assert (hdf5_length(hdf5, "masks"), read_hdf5(hdf5, "masks").shape) == (5, (5, 2, 3))


def test_bad_hdf5(hdf5: Path) -> None:
    for key in ("pose", "group"):
        with pytest.raises(DyngsError, match=f"the data set '{key}' is missing"):
            read_hdf5(hdf5, key)
    with pytest.raises(DyngsError, match="no such file"):
        read_hdf5(hdf5.with_name("n.hdf5"), "masks")
    hdf5.write_bytes(hdf5.read_bytes()[:100])
    with pytest.raises(DyngsError, match="must be a data set in an HDF5 file") as caught:
        read_hdf5(hdf5, "masks")
    assert "\n" not in str(caught.value)


def test_hdf5_that_asks_for_much_or_lies_elsewhere(tmp_path: Path) -> None:
    """A data set of 800 GB, of which nothing is there; one in another file; one of texts; a
    link."""
    h5py: Any = pytest.importorskip("h5py")
    path = tmp_path / "m.hdf5"
    (tmp_path / "other").write_bytes(bytes(800))
    with h5py.File(path, "w") as file:
        file.create_dataset("huge", shape=(10**9, 100), chunks=(1000, 100), dtype="u1")
        file.create_dataset("wide", shape=(2, 10**9), chunks=(1, 1000), dtype="u1")
        file.create_dataset(
            "other", shape=(100,), dtype="f8", external=[(str(tmp_path / "other"), 0, 800)]
        )
        file.create_dataset("text", data=["a", "b"])
        file["linked"] = h5py.ExternalLink("n.hdf5", "huge")
    lines = {
        "huge": "data.max_megapixels is",
        "other": "'other' is missing",
        "text": "'text' must hold numbers",
        "linked": "'linked' is missing",
    }
    for key, line in lines.items():
        with pytest.raises(DyngsError, match=line):
            read_hdf5(path, key)
    with pytest.raises(DyngsError, match=r"data\.max_megapixels is"):
        read_hdf5(path, "wide", 1)
    assert hdf5_length(path, "huge") == 10**9


def test_without_h5py_the_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(
        DyngsError, match=r"x\.hdf5: HDF5 files need .* pip install 'dyngs\[people\]'"
    ):
        read_hdf5(tmp_path / "x.hdf5", "masks")


def test_hdf5_that_leads_to_another_file(hdf5: Path) -> None:
    """By a link, a virtual data set or external storage: none is followed."""
    h5py = pytest.importorskip("h5py")
    private = hdf5.with_name("private.bin")
    private.write_bytes(bytes(range(6)))
    with h5py.File(hdf5, "a") as file:
        file["linked"] = h5py.ExternalLink("m2.hdf5", "masks")
        file["soft"] = h5py.SoftLink("/linked")
        file.create_dataset("outside", (1, 2, 3), np.uint8, external=[(str(private), 0, 6)])
        layout = h5py.VirtualLayout((5, 2, 3), np.uint8)
        layout[:] = h5py.VirtualSource("m2.hdf5", "masks", (5, 2, 3))
        file.create_virtual_dataset("virtual", layout)
    hdf5.with_name("m2.hdf5").write_bytes(hdf5.read_bytes())
    for key in ("linked", "soft", "outside", "virtual"):
        with pytest.raises(DyngsError, match=f"the data set '{key}' is missing"):
            read_hdf5(hdf5, key)


def test_hdf5_that_would_fill_the_memory(hdf5: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(hdf5, "a") as file:
        file.create_dataset("empty", (10**6, 10**6), np.float32)
        file.create_dataset(
            "row", (2, 10**5, 10**5), np.uint8, chunks=(1, 1000, 1000), compression="gzip"
        )
        file.create_dataset(
            "chunk", (200, 1000, 1000), np.uint8, chunks=(200, 1000, 1000), compression="gzip"
        )
    for key, rows in (("empty", ...), ("row", 0), ("chunk", 0)):
        with pytest.raises(DyngsError, match=r"m\.hdf5: .*data\.max_megapixels is 150"):
            read_hdf5(hdf5, key, rows)
    assert hdf5_length(hdf5, "empty") == 10**6


def test_damaged_hdf5_is_read_or_refused_in_one_line(hdf5: Path) -> None:
    data = hdf5.read_bytes()
    lines = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        changed = bytearray(data)
        for _ in range(rng.choice([1, 4, 16])):
            changed[int(rng.integers(len(changed)))] = rng.integers(256)
        hdf5.write_bytes(changed)
        try:
            read_hdf5(hdf5, "masks", 3)
        except DyngsError as error:
            lines.append(str(error))
    assert [line for line in lines if str(hdf5) not in line or "\n" in line] == []
