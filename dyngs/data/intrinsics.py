"""Pinhole matrices of stored pictures and how they follow the picture's size."""

from __future__ import annotations

import numpy as np

from dyngs.errors import DyngsError


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
        DyngsError: the picture's aspect is another one, so that no rescaling is right.
    """
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


def rescale_warning(where: list[str]) -> list[str]:
    """One line on pictures whose intrinsics were rescaled, or nothing."""
    if not where:
        return []
    return [f"{len(where)} pictures have another size than their intrinsics, which were rescaled; first {where[0]}"]
