"""Conventions shared by every module: shape letters, frames, units, enums.

Shape letters used in all docstrings:

====== ==========================================================
N      Gaussians
V      views (cameras)
H, W   image height and width in pixels
K      spherical-harmonics terms, ``(degree + 1) ** 2``
D      colour or feature channels
J, M   joints, mesh vertices
F      frames of a sequence
====== ==========================================================

Frames: cameras are OpenCV (x right, y down, z forward); ``cam_from_world`` maps world points to
camera points. Quaternions are wxyz. The centre of the first pixel is (0.5, 0.5). Time lies in [0,
1] over the capture. Colours are display-referred sRGB in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

import numpy as np

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic: ``rgb = SH_C0 * f_dc + 0.5``."""

MAX_SH_DEGREE = 4

ProgressCallback = Callable[[str, int, int], None]
"""Progress callback, called with a description, the completed steps and the total steps."""


def ignore_progress(what: str, done: int, total: int) -> None:
    """Default ``ProgressCallback`` that does nothing."""


class RasterizeMode(str, Enum):
    """Handling of opacity by the 2D low-pass filter."""

    CLASSIC = "classic"
    """Add ``eps2d`` to the diagonal of the 2D covariance, opacity unchanged (3DGS)."""
    ANTIALIASED = "antialiased"
    """Also scale the opacity by sqrt(det / det_filtered) (Mip-Splatting 2D filter)."""


def num_sh_terms(degree: int) -> int:
    """Return the number of SH terms K of ``degree``."""
    return (degree + 1) ** 2


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Return the sRGB signal of linear light in [0, 1]."""
    return np.where(
        linear <= 0.0031308,
        12.92 * linear,
        1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055,
    )


def decode_srgb(signal: np.ndarray) -> np.ndarray:
    """Return the linear light of an sRGB signal in [0, 1]."""
    return np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)
