from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from dyngs.data.capture import Lens, View
from dyngs.data.images.lens import undistort_map, undistorted_points
from dyngs.data.images.resampling import flow_at, nearest_positions, resized, taken_at

INTRINSICS = np.array([[40.0, 0, 16], [0, 42.0, 12], [0, 0, 1]])


def test_nothing_is_averaged() -> None:
    values = torch.arange(24.0).reshape(4, 6, 1)
    torch.testing.assert_close(taken_at(values, nearest_positions(6, 4)), values)
    assert taken_at(values, nearest_positions(3, 2))[..., 0].tolist() == [[7, 9, 11], [19, 21, 23]]


def test_flow_is_measured_in_pixels_of_the_smaller_image() -> None:
    flow = torch.tensor([4.0, -2.0]).expand(8, 12, 2)
    small = resized(flow, 6, 2)
    assert small.shape == (2, 6, 2)
    torch.testing.assert_close(small, torch.tensor([2.0, -0.5]).expand(2, 6, 2))


def test_flow_through_a_lens_ends_where_the_pinhole_sees_the_point() -> None:
    """Flow of 3 px in the distorted image: its two ends, undistorted."""
    lens = Lens("opencv", (0.1, -0.02, 0.001, 0.002))
    view = View("a", Path("a.png"), np.eye(4), INTRINSICS, 32, 24, lens)
    flow = torch.tensor([3.0, 0.0]).expand(24, 32, 2)
    lens_map = undistort_map(lens, INTRINSICS, 32, 24)
    found = flow_at(flow, view, (32, 24), lens_map)
    start = torch.tensor([20.5, 8.5])
    stored = (lens_map.grid[8, 20] + 1) / 2 * torch.tensor([32.0, 24.0])
    end = undistorted_points(lens, INTRINSICS, stored + torch.tensor([3.0, 0.0]))
    torch.testing.assert_close(found[8, 20], end - start, rtol=0, atol=1e-3)
    torch.testing.assert_close(undistorted_points(lens, INTRINSICS, stored), start, rtol=0, atol=1e-2)
