"""Silhouettes become the alpha of images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny_captures import random_pixels, write_image

from dyngs.data.capture import Silhouette
from dyngs.data.images.silhouettes import cut_out, silhouette_box
from dyngs.errors import DyngsError


@pytest.mark.parametrize(
    ("person", "expected"),
    [("white", [0, 1, 128, 255]), ("black", [255, 254, 127, 0]), ("nonzero", [0, 255, 255, 255])],
)
def test_silhouettes_become_alpha(tmp_path: Path, person: Any, expected: list[int]) -> None:
    write_image(tmp_path / "m.png", np.array([[[0], [1], [128], [255]]], np.uint8))
    pixels = torch.from_numpy(random_pixels(1, 4, 3))
    cut = cut_out(pixels, Silhouette(tmp_path / "m.png", person))
    assert cut[0, :, 3].tolist() == expected
    assert torch.equal(cut[..., :3], pixels)


def test_silhouettes_and_alpha_multiply(tmp_path: Path) -> None:
    write_image(tmp_path / "m.png", np.array([[[0], [128], [255]]], np.uint8))
    pixels = torch.tensor([[[9, 9, 9, 200]] * 3], dtype=torch.uint8)
    assert cut_out(pixels, Silhouette(tmp_path / "m.png", "white"))[0, :, 3].tolist() == [0, 100, 200]


def test_bad_silhouettes(tmp_path: Path) -> None:
    write_image(tmp_path / "m.png", np.zeros((2, 3, 1), np.uint8))
    with pytest.raises(DyngsError, match=r"m\.png: the mask is 3x2 but its image is 4x1"):
        cut_out(torch.zeros(1, 4, 3, dtype=torch.uint8), Silhouette(tmp_path / "m.png", "white"))
    with pytest.raises(DyngsError, match=r"n\.png: no such image"):
        cut_out(torch.zeros(1, 4, 3, dtype=torch.uint8), Silhouette(tmp_path / "n.png", "white"))


def test_silhouettes_in_hdf5(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="needs dyngs[people]")
    hdf5 = tmp_path / "m.hdf5"
    masks = np.zeros((5, 2, 3), np.uint8)
    masks[3, 1, 2] = 1
    with h5py.File(hdf5, "w") as file:
        file.create_dataset("masks", data=masks, compression="lzf")
    pixels = torch.zeros(2, 3, 3, dtype=torch.uint8)
    assert cut_out(pixels, Silhouette(hdf5, "nonzero", 3))[..., 3].tolist() == [[0, 0, 0], [0, 0, 255]]
    with pytest.raises(DyngsError, match="'masks' must be a data set in an HDF5 file"):
        cut_out(pixels, Silhouette(hdf5, "nonzero", 5))


def test_the_box_holds_all_that_is_shown() -> None:
    alpha = torch.zeros(5, 7)
    assert silhouette_box(alpha) is None
    alpha[1, 2], alpha[3, 5] = 0.4, 0.9
    assert silhouette_box(alpha) == (slice(1, 4), slice(2, 6))
    assert silhouette_box(alpha, 0.5) == (slice(3, 4), slice(5, 6))
