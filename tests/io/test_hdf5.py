"""Data sets of HDF5 files, damaged and hostile ones among them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dyngs.core.errors import DyngsError
from dyngs.io.numpy_files import hdf5_length, read_hdf5


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
        with pytest.raises(DyngsError, match=f"'{key}' must be a data set of numbers"):
            read_hdf5(hdf5, key)
    with pytest.raises(DyngsError, match="no such file"):
        read_hdf5(hdf5.with_name("n.hdf5"), "masks")
    hdf5.write_bytes(hdf5.read_bytes()[:100])
    with pytest.raises(DyngsError, match="must be a data set in an HDF5 file") as caught:
        read_hdf5(hdf5, "masks")
    assert "\n" not in str(caught.value)


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
        with pytest.raises(DyngsError, match=f"'{key}' must be a data set of numbers"):
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
        with pytest.raises(DyngsError, match=r"m\.hdf5: .* pixels exceed"):
            read_hdf5(hdf5, key, rows)
    assert hdf5_length(hdf5, "empty") == 10**6
