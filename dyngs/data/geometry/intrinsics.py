"""Pinhole matrices of stored pictures and how they follow the picture's size."""

from __future__ import annotations

import numpy as np

from dyngs.errors import DyngsError

MAX_SIDE = 2**20
"""Pixels of a side of a picture; more is taken for a mistake."""
FOCAL_RANGE = (1e-4, 1e6)
"""Focal lengths in longer sides of the picture; others are taken for mistakes: 179.99 degrees, and 0.00006 degrees."""


def pinhole_matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """(3, 3) float64 camera matrix, pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def scaled_intrinsics(intrinsics: np.ndarray, scale_x: float, scale_y: float) -> np.ndarray:
    """(3, 3) matrix for the picture stretched by the two factors; exact, as pixel centres lie at (0.5, 0.5)."""
    return np.diag([scale_x, scale_y, 1.0]) @ intrinsics


def match_size(
    intrinsics: np.ndarray, described: tuple[int, int], stored: tuple[int, int] | None, where: str
) -> tuple[np.ndarray, tuple[int, int], bool]:
    """The intrinsics for the picture as it is stored, its (width, height), and whether they had to be rescaled.

    Args:
        intrinsics: (3, 3) for a picture of ``described`` (width, height).
        stored: (width, height) of the file, None where it could not be opened.
        where: the picture, for messages.

    Raises:
        DyngsError: the picture's aspect is another one, so that no rescaling is right; a focal length or a principal
            point that no camera has.
    """
    _check_plausible(intrinsics, described, where)
    if stored is None or stored == described:
        return intrinsics, described, False
    scale_x, scale_y = stored[0] / described[0], stored[1] / described[1]
    # Each side of a shrunk picture was rounded to whole pixels: half a pixel either way is the same aspect.
    slack = max(0.5 / stored[0], 0.5 / stored[1]) + 1e-9
    if abs(scale_x / scale_y - 1) > 2 * slack:
        turned = " (turned by its EXIF tag?)" if stored == described[::-1] else ""
        raise DyngsError(
            f"{where}: the picture is {stored[0]}x{stored[1]} but its intrinsics are for {described[0]}x{described[1]}"
            f"{turned}; correct the size and focal length or restore the original picture"
        )
    return scaled_intrinsics(intrinsics, scale_x, scale_y), stored, True


def _check_plausible(intrinsics: np.ndarray, described: tuple[int, int], where: str) -> None:
    side = max(described)
    low, high = FOCAL_RANGE[0] * side, FOCAL_RANGE[1] * side
    fx, fy, *center = (float(intrinsics[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if not (low <= fx <= high and low <= fy <= high):
        raise DyngsError(
            f"{where}: the focal length ({fx:g}, {fy:g}) px does not suit a picture of {described[0]}x{described[1]}; "
            "correct it, or the field of view that it follows from"
        )
    if not all(abs(x) <= high for x in center):
        raise DyngsError(f"{where}: the principal point ({center[0]:g}, {center[1]:g}) px lies too far out; correct it")


def rescale_warning(where: list[str]) -> list[str]:
    """One line on pictures whose intrinsics were rescaled, or nothing."""
    if not where:
        return []
    return [f"{len(where)} pictures have another size than their intrinsics, which were rescaled; first {where[0]}"]
