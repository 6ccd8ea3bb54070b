from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_captures import write_image

from dyngs.data.images.depth import read_depth, read_labels
from dyngs.errors import DyngsError


def test_sixteen_bits_are_millimetres_and_zero_is_unknown(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", np.array([[[0], [1]], [[1500], [65535]]], np.uint16))
    np.testing.assert_allclose(read_depth(tmp_path / "a.png").numpy(), [[0, 0.001], [1.5, 65.535]], rtol=1e-6)


@pytest.mark.parametrize("ending", ["npy", "npz", "exr"])
def test_floats_are_taken_as_they_are(tmp_path: Path, ending: str) -> None:
    values = np.array([[2.5, np.nan], [np.inf, -1.0]], np.float32)
    path = tmp_path / f"a.{ending}"
    if ending == "npy":
        np.save(path, values)
    elif ending == "npz":
        np.savez(path, depth=values, other=np.zeros(3))
    else:
        write_image(path, values[..., None])
    assert read_depth(path).tolist() == [[2.5, 0], [0, 0]]


def test_labels_of_sixteen_bits_are_not_rounded_away(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", np.array([[[0], [1], [300]]], np.uint16))
    assert read_labels(tmp_path / "a.png").tolist() == [[False, True, True]]


@pytest.mark.parametrize("shape", [(4,), (0, 3), (2, 2, 2, 2)])
def test_other_shapes_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.save(tmp_path / "a.npy", np.ones(shape))
    with pytest.raises(DyngsError, match=r"a\.npy: a depth map must be"):
        read_depth(tmp_path / "a.npy")


def test_missing_and_ambiguous_files(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"a\.npy: no such file"):
        read_depth(tmp_path / "a.npy")
    np.savez(tmp_path / "a.npz", one=np.ones((2, 2)), two=np.ones((2, 2)))
    with pytest.raises(DyngsError, match="depth"):
        read_depth(tmp_path / "a.npz")
