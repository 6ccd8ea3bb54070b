"""Interface of detectors of people, and what they return.

Local letters: H height, W width of an image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

SURE = 0.3
"""Least confidence of a key point that counts."""


@dataclass(frozen=True)
class Detection:
    """A person in an image.

    Attributes:
        keypoints: (17, 3) float32 in the order of COCO: column and row in pixels, and confidence in
            [0, 1].
        mask: (H, W) uint8, 255 = the person.
    """

    keypoints: np.ndarray
    mask: np.ndarray

    @cached_property
    def box(self) -> np.ndarray:
        """First and last column, first and last row (left, top, right, bottom), pixels; zeros where
        nothing is sure."""
        person = self.mask > 127
        if person.any():
            rows, columns = (person.any(side).nonzero()[0] for side in (1, 0))
            return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float64)
        sure = self.keypoints[self.keypoints[:, 2] > SURE, :2]
        return (
            np.concatenate([sure.min(0), sure.max(0)]).astype(np.float64)
            if len(sure)
            else np.zeros(4)
        )

    @property
    def height(self) -> float:
        """Of the box, pixels."""
        return float(self.box[3] - self.box[1])


class Detector(Protocol):
    """A program that finds people."""

    @property
    def name(self) -> str:
        """What it is called, for messages."""
        ...

    def detect(self, images: Sequence[Path]) -> list[list[Detection]]:
        """Return the people in each of the images of one camera, which are PNG files of one size in
        order of time.

        Raises DyngsError: it cannot be started, or fails.
        """
        ...
