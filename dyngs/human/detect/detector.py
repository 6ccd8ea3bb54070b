"""Interface of detectors of people, and what they return.

Local letters: H height, W width of an image.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

from dyngs.core.errors import DyngsError, quote_path
from dyngs.human.detect import mediapipe_worker
from dyngs.io.numpy_files import read_arrays

MIN_CONFIDENCE = 0.3
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
        sure = self.keypoints[self.keypoints[:, 2] > MIN_CONFIDENCE, :2]
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

    def detect(self, images: Sequence[Path]) -> list[Detection | None]:
        """Return the person in each of the images of one camera, which are PNG files of one size in
        order of time; None where nobody is found.

        Raises DyngsError: it cannot be started, or fails.
        """
        ...


MEDIAPIPE_VARIABLE = "DYNGS_MEDIAPIPE"
"""Environment variable: the Python interpreter of an environment with MediaPipe."""
MEDIAPIPE_PACKAGE = "mediapipe==0.10.21"
"""The last version that has its models in its wheel and needs no download when it runs."""
INSTALL_HINT = (
    f"`python -m venv ENV && ENV/bin/pip install {MEDIAPIPE_PACKAGE}` (Python 3.9 to 3.12), "
    f"then give --mediapipe ENV/bin/python or set {MEDIAPIPE_VARIABLE} to it"
)
MASKS_HINT = "or give masks of another program to `dyngs data fit` (`dyngs docs people`)"
LANDMARKS = (0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28)
"""Rows of MediaPipe's landmarks that are the key points of COCO, in their order."""
_SECONDS_PER_IMAGE, _SECONDS_TO_START = 10.0, 120.0


class MediaPipe:
    """MediaPipe's pose detector in another Python environment; it finds one person in an image."""

    name = "MediaPipe"

    def __init__(self, python: Path | None = None) -> None:
        """``python``: the interpreter of that environment; None: ``$DYNGS_MEDIAPIPE``. Raises
        DyngsError: not there."""
        named = os.environ.get(MEDIAPIPE_VARIABLE, "")
        chosen = python or (Path(named).expanduser() if named else None)
        if chosen is None:
            raise DyngsError(
                f"no detector finds the person: install MediaPipe with {INSTALL_HINT}; {MASKS_HINT}"
            )
        if not chosen.is_file():
            raise DyngsError(
                f"{chosen}: no such Python interpreter; install MediaPipe with {INSTALL_HINT}"
            )
        self._python = chosen

    def detect(self, images: Sequence[Path]) -> list[Detection | None]:
        """Return the person in each image; the images must lie in one folder that holds no
        others."""
        if not images:
            return []
        with tempfile.TemporaryDirectory(prefix="dyngs-mediapipe-") as out:
            self._run(
                images[0].parent, Path(out), _SECONDS_TO_START + _SECONDS_PER_IMAGE * len(images)
            )
            return [_read(Path(out) / f"{image.stem}.npz") for image in images]

    def _run(self, images: Path, out: Path, seconds: float) -> None:
        # -I: neither PYTHONPATH nor the current folder put packages of dyngs's environment before
        # those of this one
        command = [str(self._python), "-I", str(mediapipe_worker.__file__), str(images), str(out)]
        environment = {**os.environ, "GLOG_minloglevel": "3", "TF_CPP_MIN_LOG_LEVEL": "3"}
        try:
            done = subprocess.run(
                command,
                env=environment,
                capture_output=True,
                text=True,
                timeout=seconds,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise DyngsError(
                f"{self._python}: MediaPipe ran for {seconds:.0f} s; try fewer frames"
            ) from None
        except OSError as error:
            raise DyngsError(f"cannot start {self._python}: {error.strerror or error}") from error
        if done.returncode == mediapipe_worker.NO_MEDIAPIPE:
            raise DyngsError(
                f"{self._python}: {_last_line(done.stderr)}; give the interpreter of an environment made by "
                f"`{quote_path(self._python)} -m pip install {MEDIAPIPE_PACKAGE}`"
            )
        if done.returncode:
            raise DyngsError(
                f"{self._python}: MediaPipe failed ({done.returncode}): {_last_line(done.stderr)}"
            )


def _last_line(said: str) -> str:
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    return lines[-1][:200] if lines else "nothing was said"


def _read(path: Path) -> Detection | None:
    if not path.is_file():
        return None
    arrays = read_arrays(path, lambda _: ("landmarks", "mask"))
    return Detection(arrays["landmarks"][list(LANDMARKS)].astype(np.float32), arrays["mask"])
