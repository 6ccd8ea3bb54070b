"""Conversion of HDR (HLG, PQ) and wide-gamut images to 8-bit sRGB, by lookup tables."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from dyngs.core.conventions import srgb_decoded, srgb_encoded

UNSPECIFIED = 2
BT2020, _DISPLAY_P3 = 9, 12
_PQ, _HLG = 16, 18

_TO_BT709 = {
    BT2020: (
        (1.660491, -0.587641, -0.072850),
        (-0.124550, 1.132900, -0.008349),
        (-0.018151, -0.100579, 1.118730),
    ),
    _DISPLAY_P3: (
        (1.224940, -0.224940, 0.0),
        (-0.042057, 1.042057, 0.0),
        (-0.019638, -0.078636, 1.098274),
    ),
}
"""Linear RGB of BT.709 from that of other primaries with the same white."""

_REFERENCE_WHITE = 203.0  # cd/m2 of diffuse white in PQ, by BT.2408
_HLG_WHITE = 0.75  # signal of diffuse white in HLG, by BT.2408
_LEVELS = 65535
_ROWS = 32  # rows that are converted at a time: they fit into caches


@dataclass(frozen=True)
class ColourTags:
    """Code points of ITU-T H.273 for the colours of an image, and whether its range is full."""

    primaries: int = UNSPECIFIED
    transfer: int = UNSPECIFIED
    matrix: int = UNSPECIFIED
    is_full_range: bool = False

    def or_else(self, other: ColourTags) -> ColourTags:
        """Return these tags, and those of ``other`` where they are unspecified."""
        return ColourTags(
            other.primaries if self.primaries == UNSPECIFIED else self.primaries,
            other.transfer if self.transfer == UNSPECIFIED else self.transfer,
            other.matrix if self.matrix == UNSPECIFIED else self.matrix,
            self.is_full_range or other.is_full_range,
        )

    @property
    def gamut(self) -> int:
        """The primaries; those of HDR are BT.2020 unless tagged."""
        is_hdr = self.transfer in (_PQ, _HLG)
        return BT2020 if is_hdr and self.primaries == UNSPECIFIED else self.primaries

    @property
    def conversion(self) -> str:
        """A line on how ``to_srgb`` converts these colours; "" if they are sRGB already."""
        if self.transfer == _HLG:
            return f"HLG is tone-mapped to SDR (white: {_HLG_WHITE:.0%} of the signal; brighter is clipped)"
        if self.transfer == _PQ:
            return (
                f"PQ is tone-mapped to SDR (white: {_REFERENCE_WHITE:g} cd/m2; brighter is clipped)"
            )
        name = {BT2020: "BT.2020", _DISPLAY_P3: "Display P3"}.get(self.primaries)
        return f"colours are converted from {name} to BT.709" if name else ""


def to_srgb(pixels: np.ndarray, tags: ColourTags, white: int = _LEVELS) -> np.ndarray:
    """Return (H, W, 3) uint8 sRGB of (H, W, 3) uint16 RGB, whose levels are 0 to ``white``.

    Light above diffuse white is clipped. The system gamma of HLG is left out, as in the mapping of
    scene light of BT.2408: SDR images that were encoded as HLG are restored.
    """
    matrix = _LEVELS * np.array(_TO_BT709.get(tags.gamut, np.eye(3)), np.float32).T
    encoded = np.empty(pixels.shape, np.uint8)
    for begin in range(0, len(pixels), _ROWS):
        rows = slice(begin, begin + _ROWS)
        linear = _linear_table(tags.transfer, white).take(pixels[rows]) @ matrix
        _srgb_table().take(linear.astype(np.int32), out=encoded[rows], mode="clip")
    return encoded


@lru_cache
def _linear_table(transfer: int, white: int) -> np.ndarray:
    """Return the linear light of every 16-bit level of a transfer curve, 1 = diffuse white."""
    signal = np.minimum(np.arange(_LEVELS + 1) / white, 1.0)
    if transfer == _HLG:
        linear = _hlg_linear(signal) / _hlg_linear(np.array(_HLG_WHITE))
    elif transfer == _PQ:
        linear = _pq_linear(signal) * 10_000 / _REFERENCE_WHITE
    else:
        linear = srgb_decoded(signal)
    return linear.astype(np.float32)


def _hlg_linear(signal: np.ndarray) -> np.ndarray:
    """Scene light by the inverse OETF of HLG, BT.2100 table 5."""
    a = 0.17883277
    b = 0.28466892
    c = 0.55991073
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)


def _pq_linear(signal: np.ndarray) -> np.ndarray:
    """Light in 10,000 cd/m2 by the EOTF of PQ, BT.2100 table 4."""
    power = signal ** (1 / 78.84375)
    return (np.maximum(power - 0.8359375, 0.0) / (18.8515625 - 18.6875 * power)) ** (
        1 / 0.1593017578125
    )


@lru_cache
def _srgb_table() -> np.ndarray:
    """Return the 8-bit sRGB level of linear light in 65,536 steps."""
    return np.round(255 * srgb_encoded(np.arange(_LEVELS + 1) / _LEVELS)).astype(np.uint8)
