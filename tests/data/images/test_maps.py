"""Depth, flow and silhouette maps: values, sampling at pixels, and one-line errors."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_captures import write_image

from dyngs.core.errors import DyngsError
from dyngs.data.capture import Lens, View
from dyngs.data.images.lens import undistort_map, undistort_points
from dyngs.data.images.maps import (
    flow_at,
    nearest_positions,
    read_depth,
    read_flow,
    sample_nearest,
    silhouette_box,
)


def test_sixteen_bits_are_millimetres_and_zero_is_unknown(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", np.array([[[0], [1]], [[1500], [65535]]], np.uint16))
    np.testing.assert_allclose(
        read_depth(tmp_path / "a.png").numpy(), [[0, 0.001], [1.5, 65.535]], rtol=1e-6
    )


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


def flo(width: int, height: int, values: np.ndarray) -> bytes:
    return struct.pack("<fii", 202021.25, width, height) + values.astype("<f4").tobytes()


def test_all_three_kinds_of_files_hold_the_same(tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(size=(3, 5, 2)).astype(np.float32)
    np.save(tmp_path / "a.npy", values)
    np.savez(tmp_path / "a.npz", anything=values)
    (tmp_path / "a.flo").write_bytes(flo(5, 3, values))
    for ending in ("npy", "npz", "flo"):
        np.testing.assert_array_equal(read_flow(tmp_path / f"a.{ending}").numpy(), values)


def test_sizes_are_checked_before_memory_is_allocated(tmp_path: Path) -> None:
    (tmp_path / "a.flo").write_bytes(flo(2**30, 2**30, np.zeros(2)))
    with pytest.raises(DyngsError, match="pixels exceed"):
        read_flow(tmp_path / "a.flo")


def test_the_box_holds_all_that_is_shown() -> None:
    alpha = torch.zeros(5, 7)
    assert silhouette_box(alpha) is None
    alpha[1, 2], alpha[3, 5] = 0.4, 0.9
    assert silhouette_box(alpha) == (slice(1, 4), slice(2, 6))
    assert silhouette_box(alpha, 0.5) == (slice(3, 4), slice(5, 6))


INTRINSICS = np.array([[40.0, 0, 16], [0, 42.0, 12], [0, 0, 1]])


def test_nothing_is_averaged() -> None:
    values = torch.arange(24.0).reshape(4, 6, 1)
    torch.testing.assert_close(sample_nearest(values, nearest_positions(6, 4)), values)
    assert sample_nearest(values, nearest_positions(3, 2))[..., 0].tolist() == [
        [7, 9, 11],
        [19, 21, 23],
    ]


def test_flow_through_a_lens_ends_where_the_pinhole_sees_the_point() -> None:
    """Flow of 3 px in the distorted image: its two ends, undistorted."""
    lens = Lens("opencv", (0.1, -0.02, 0.001, 0.002))
    view = View("a", Path("a.png"), np.eye(4), INTRINSICS, 32, 24, lens)
    flow = torch.tensor([3.0, 0.0]).expand(24, 32, 2)
    lens_map = undistort_map(lens, INTRINSICS, 32, 24)
    found = flow_at(flow, view, (32, 24), lens_map)
    start = torch.tensor([20.5, 8.5])
    stored = (lens_map.grid[8, 20] + 1) / 2 * torch.tensor([32.0, 24.0])
    end = undistort_points(lens, INTRINSICS, stored + torch.tensor([3.0, 0.0]))
    torch.testing.assert_close(found[8, 20], end - start, rtol=0, atol=1e-3)
    torch.testing.assert_close(undistort_points(lens, INTRINSICS, stored), start, rtol=0, atol=1e-2)
