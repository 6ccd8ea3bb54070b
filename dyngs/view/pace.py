"""How large images are drawn: small while something moves, so that they come often; full when all
is still."""

from __future__ import annotations

import math
from dataclasses import dataclass

FIRST_AREA = 320 * 240
SMALLEST_AREA = 160 * 120
STILL_AFTER = 0.2
"""Seconds without change after which the image is refined."""
_REFINES_BY = 6.0
"""Factor of the number of pixels from one refinement to the next."""
_PIXELS_FRACTION = 0.5
"""Seconds for pixels relative to those for the Gaussians, where the latter alone exceed the target:
a smaller image would hardly come sooner."""
_MEMORY = 0.7
_TELLING = 3.0
"""Ratio of the pixels of two images from which their times tell how much a pixel takes."""
_LEAST_FRACTION = 0.5
"""Fraction of the seconds that is taken to be for pixels, where nothing tells."""


@dataclass
class _Mean:
    """Running means of the pixels and the seconds of images."""

    pixels: float = 0.0
    seconds: float = 0.0
    count: int = 0

    def add(self, pixels: float, seconds: float) -> None:
        kept = _MEMORY if self.count else 0.0
        self.pixels = kept * self.pixels + (1 - kept) * pixels
        self.seconds = kept * self.seconds + (1 - kept) * seconds
        self.count += 1


class Pace:
    """Number of pixels that can be drawn within ``target`` seconds, by how long the last images
    took.

    Seconds are taken to be a + b * pixels: a is for the Gaussians, whatever the size of the image.
    Refined images may take ``longest`` seconds. ``area``: pixels of an image while something moves.
    """

    def __init__(self, target: float, longest: float = math.inf) -> None:
        self._target, self._longest = target, longest
        self.area = float(FIRST_AREA)
        self._moving, self._refined = _Mean(), _Mean()

    @property
    def largest(self) -> float:
        """Most pixels of a refined image."""
        if not self._moving.count or math.isinf(self._longest):
            return math.inf
        return max(self._area_within(self._longest), self.area)

    def observe(self, pixels: float, seconds: float, *, is_refined: bool) -> None:
        """Note how long an image took: a small one while something moves, or a refined one."""
        (self._refined if is_refined else self._moving).add(pixels, seconds)
        if not self._moving.count:
            return
        factor = min(max(self._area_within(self._target) / self.area, 0.5), 2.0)
        self.area = max(self.area * math.sqrt(factor), SMALLEST_AREA)

    def _area_within(self, seconds: float) -> float:
        """Return the pixels that can be drawn within ``seconds``."""
        per_pixel = self._seconds_per_pixel()
        fixed = max(self._moving.seconds - per_pixel * self._moving.pixels, 0.0)
        return max(seconds - fixed, _PIXELS_FRACTION * fixed) / per_pixel

    def _seconds_per_pixel(self) -> float:
        small = self._moving
        large = self._refined
        slope, least = 0.0, _LEAST_FRACTION
        if large.pixels > _TELLING * small.pixels:  # times of images of like sizes differ by chance
            slope = (large.seconds - small.seconds) / (large.pixels - small.pixels)
            least = 0.1 * _LEAST_FRACTION
        return max(slope, least * small.seconds / small.pixels, 1e-12)

    def next_area(self, full: int, drawn: float | None) -> float:
        """Return the pixels to draw next, of ``full``; ``drawn``: of what is shown, None where
        something moves."""
        return min(float(full), self.area if drawn is None else max(_REFINES_BY * drawn, self.area))


def size_within(size: tuple[int, int], area: float) -> tuple[int, int]:
    """Return width and height with the aspect of ``size`` and at most about ``area`` pixels, at
    least 16 each."""
    width, height = size
    scale = min(1.0, math.sqrt(area / max(width * height, 1)))
    if scale >= 1:
        return size
    return max(16, round(width * scale)), max(16, round(height * scale))
