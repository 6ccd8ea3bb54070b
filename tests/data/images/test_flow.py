from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from dyngs.data.images.flow import read_flow
from dyngs.errors import DyngsError


def flo(width: int, height: int, values: np.ndarray) -> bytes:
    return struct.pack("<fii", 202021.25, width, height) + values.astype("<f4").tobytes()


def test_all_three_kinds_of_files_hold_the_same(tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(size=(3, 5, 2)).astype(np.float32)
    np.save(tmp_path / "a.npy", values)
    np.savez(tmp_path / "a.npz", anything=values)
    (tmp_path / "a.flo").write_bytes(flo(5, 3, values))
    for ending in ("npy", "npz", "flo"):
        np.testing.assert_array_equal(read_flow(tmp_path / f"a.{ending}").numpy(), values)


def test_huge_and_infinite_displacements_are_unknown(tmp_path: Path) -> None:
    values = np.zeros((1, 3, 2), np.float32)
    values[0, 1, 0], values[0, 2, 1] = 1e10, np.inf
    (tmp_path / "a.flo").write_bytes(flo(3, 1, values))
    assert read_flow(tmp_path / "a.flo").isnan().all(-1).tolist() == [[False, True, True]]


@pytest.mark.parametrize("data", [b"", b"no flow at all, but text", flo(5, 3, np.zeros(7)), flo(-1, 3, np.zeros(7))])
def test_damaged_files_are_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.flo").write_bytes(data)
    with pytest.raises(DyngsError, match=r"a\.flo"):
        read_flow(tmp_path / "a.flo")


def test_sizes_are_checked_before_memory_is_allocated(tmp_path: Path) -> None:
    (tmp_path / "a.flo").write_bytes(flo(2**30, 2**30, np.zeros(2)))
    with pytest.raises(DyngsError, match="megapixels"):
        read_flow(tmp_path / "a.flo")


def test_arrays_that_are_no_flow(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((3, 5)))
    with pytest.raises(DyngsError, match=r"must be \(height, width, 2\)"):
        read_flow(tmp_path / "a.npy")
