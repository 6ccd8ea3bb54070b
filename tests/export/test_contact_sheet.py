"""Contact sheets and coloured depth."""

from __future__ import annotations

import numpy as np
import pytest

from dyngs.export.contact_sheet import (
    BACKGROUND,
    GAP,
    LABEL_HEIGHT,
    SheetRow,
    color_map,
    contact_sheet,
    depth_limits,
    depth_to_rgb,
)

RNG = np.random.default_rng(0)


def test_sheet_holds_truth_render_and_error() -> None:
    truth = RNG.uniform(size=(20, 30, 3)).astype(np.float32)
    rendered = np.clip(truth + 0.1, 0, 1)
    sheet = contact_sheet([SheetRow("one", truth, truth), SheetRow("two", truth, rendered)])
    assert sheet.shape == (2 * (LABEL_HEIGHT + 20) + GAP, GAP + 3 * (30 + GAP), 3)
    top = sheet[LABEL_HEIGHT : LABEL_HEIGHT + 20]
    panels = [top[:, GAP + i * (30 + GAP) : GAP + i * (30 + GAP) + 30] for i in range(3)]
    assert np.abs(panels[0] / 255.0 - truth).max() <= 0.5 / 255 + 1e-6
    assert np.array_equal(panels[0], panels[1])
    assert panels[2].max() <= 4, "no error is black (magma's darkest)"
    below = sheet[2 * LABEL_HEIGHT + 20 : 2 * LABEL_HEIGHT + 40, -GAP - 30 : -GAP]
    assert below.mean() > 50


def test_error_gain_is_five() -> None:
    truth = np.full((8, 8, 3), 100, np.uint8)
    sheet = contact_sheet([SheetRow("", truth, truth + np.uint8(25))])
    expected = color_map(np.full((1, 1), 5 * 25 / 255), "magma")[0, 0]
    assert np.array_equal(sheet[LABEL_HEIGHT + 4, -GAP - 4], expected)


def test_large_and_unequal_images_fit() -> None:
    rows = [
        SheetRow("a" * 200, *[np.zeros((h, w, 3), np.uint8)] * 2)
        for h, w in ((40, 100), (10, 10), (1, 1))
    ]
    sheet = contact_sheet(rows, panel_width=50)
    assert sheet.shape[1] == GAP + 3 * (50 + GAP)
    assert sheet.shape[0] == 3 * LABEL_HEIGHT + 20 + 10 + 1 + GAP


def test_captions_of_small_images_end_inside() -> None:
    """At the width of the demo's panels nothing of the last letter is cut off."""
    panel = np.zeros((8, 160, 3), np.uint8)
    sheet = contact_sheet([SheetRow("31.23 dB  images/test/r_M", panel, panel)])
    ink = np.flatnonzero((sheet[:LABEL_HEIGHT, GAP : GAP + 160] != BACKGROUND).any(axis=(0, 2)))
    if not len(ink):
        pytest.skip("no font is installed")
    assert 140 < ink.max() < 159


def test_wrong_rows_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one"):
        contact_sheet([])
    with pytest.raises(ValueError, match="differ"):
        contact_sheet([SheetRow("a", np.zeros((2, 2, 3)), np.zeros((2, 3, 3)))])


def test_depth_limits_ignore_the_transparent_and_the_stray() -> None:
    depth = np.linspace(2.0, 3.0, 1000).reshape(20, 50)
    depth[0, 0], alpha = 1e9, np.ones((20, 50))
    alpha[1] = 0.0
    depth[1] = np.nan
    near, far = depth_limits(depth, alpha)
    assert 2.0 <= near < 2.1
    assert 2.9 < far < 3.0
    assert depth_limits(depth, np.zeros_like(alpha)) == (0.0, 1.0)


def test_near_is_red_far_is_blue_nothing_is_black() -> None:
    depth = np.array([[1.2, 1.8, 1.5, np.inf, np.nan]])
    rgb = depth_to_rgb(depth, np.array([[1.0, 1.0, 0.0, 0.0, 0.0]]), limits=(1.0, 2.0)).astype(int)
    assert rgb[0, 0, 0] > rgb[0, 0, 2]
    assert rgb[0, 1, 2] > rgb[0, 1, 0]
    assert rgb[0, 2:].max() == 0
    flat = depth_to_rgb(np.full((3, 3), 2.0), np.ones((3, 3)))
    assert np.ptp(flat.reshape(-1, 3), axis=0).max() == 0


def test_unknown_map_is_refused() -> None:
    with pytest.raises(ValueError, match="no colour map 'nope'"):
        color_map(np.zeros((2, 2)), "nope")
