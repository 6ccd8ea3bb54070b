"""Transfer curves and primaries: values that BT.2100, BT.2408 and BT.2087 state."""

from __future__ import annotations

import numpy as np
import pytest

from dyngs.data.images.video import BT2020, ColourTags, encode_srgb, to_srgb

PQ, HLG, DISPLAY_P3, BT709 = 16, 18, 12, 1


def grey_level(signal: float, transfer: int) -> int:
    levels = to_srgb(
        np.full((1, 1, 3), round(65535 * signal), np.uint16), ColourTags(transfer=transfer)
    )
    assert np.ptp(levels) <= 1, "grey stays grey in other primaries"
    return int(levels[0, 0, 1])


@pytest.mark.parametrize(
    ("transfer", "signal", "light"),
    [
        # BT.2100: the square root of HLG ends at half the signal, which is a twelfth of the light;
        # BT.2408: 75 % is diffuse white, and 38 % is a grey card of 18 %.
        (HLG, 0.0, 0.0),
        (HLG, 0.5, 1 / 12 / 0.265),
        (HLG, 0.75, 1.0),
        (HLG, 1.0, 1.0),
        (HLG, 0.38, 0.38**2 / 3 / 0.265),
        # BT.2408, in cd/m2: PQ signals of 58 %, 38 % and 51 %.
        (PQ, 0.0, 0.0),
        (PQ, 0.58, 203 / 203),
        (PQ, 0.38, 26 / 203),
        (PQ, 0.508, 100 / 203),
        (PQ, 1.0, 1.0),
    ],
)
def test_signals_of_the_standards(transfer: int, signal: float, light: float) -> None:
    expected = 255 * float(encode_srgb(np.array(min(light, 1.0))))
    assert grey_level(signal, transfer) == pytest.approx(expected, abs=1.5)


def test_sdr_in_its_own_primaries_is_left_alone() -> None:
    levels = np.random.default_rng(0).integers(0, 256, (100, 7, 3), np.uint8)
    assert np.array_equal(to_srgb(levels * np.uint16(257), ColourTags(BT709, BT709)), levels)
    assert np.array_equal(to_srgb(levels * np.uint16(256), ColourTags(), white=255 * 256), levels)


@pytest.mark.parametrize(
    ("primaries", "red"),
    [
        (BT2020, (0.6274, 0.0691, 0.0164)),  # BT.709's red in BT.2020, by BT.2087
        (DISPLAY_P3, (0.8225, 0.0332, 0.0171)),
    ],
)
def test_red_in_wider_primaries(primaries: int, red: tuple[float, float, float]) -> None:
    pixel = np.round(65535 * encode_srgb(np.array([[red]]))).astype(np.uint16)
    assert np.abs(to_srgb(pixel, ColourTags(primaries)).astype(int) - (255, 0, 0)).max() <= 3
