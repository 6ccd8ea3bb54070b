"""Interface of person detectors, and MediaPipe as a detector.

Symbols: H height, W width of an image.
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
from dyngs.human.fit.keypoints import MIN_CONFIDENCE
from dyngs.io.numpy_files import read_arrays


@dataclass(frozen=True)
class Detection:
    """Person detected in an image.

    Attributes:
        keypoints: (25, 3) float32 in the order of ``KEY_POINTS``: column and row, px, and
            confidence in [0, 1].
        mask: (H, W) uint8, 255 = the person.
        positions: (25, 3) float32, estimated positions of the key points relative to the hips, in
            axes of the camera (x right, y down, z forward), m; None: not estimated.
    """

    keypoints: np.ndarray
    mask: np.ndarray
    positions: np.ndarray | None = None

    @cached_property
    def box(self) -> np.ndarray:
        """Bounding box (left, top, right, bottom), px; zeros without a confident detection."""
        person = self.mask > 127
        if person.any():
            rows, columns = (person.any(side).nonzero()[0] for side in (1, 0))
            return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float64)
        confident = self.keypoints[self.keypoints[:, 2] > MIN_CONFIDENCE, :2]
        return (
            np.concatenate([confident.min(0), confident.max(0)]).astype(np.float64)
            if len(confident)
            else np.zeros(4)
        )

    @property
    def height(self) -> float:
        """Height of the box, px."""
        return float(self.box[3] - self.box[1])


class Detector(Protocol):
    """Program that detects one person per image."""

    @property
    def name(self) -> str:
        """Name for messages."""
        ...

    def detect(self, images: Sequence[Path]) -> list[Detection | None]:
        """Return the person in each image, None where nobody is detected.

        ``images`` are PNG files of any sizes, the only ones of their folder; each is searched on
        its own. Raises DyngsError: the detector cannot be started or fails.
        """
        ...


MEDIAPIPE_VARIABLE = "DYNGS_MEDIAPIPE"
"""Environment variable with the Python interpreter of an environment that has MediaPipe."""
MEDIAPIPE_PACKAGE = "mediapipe==0.10.21"
"""Last version whose wheel includes the models, so that nothing is downloaded at run time."""
INSTALL_HINT = (
    f"`python -m venv ENV && ENV/bin/pip install {MEDIAPIPE_PACKAGE}` (Python 3.9 to 3.12), "
    f"then pass --mediapipe ENV/bin/python or set {MEDIAPIPE_VARIABLE} to it"
)
MASKS_HINT = "or pass masks of another program to `dyngs data fit` (`dyngs docs people`)"
LANDMARKS = (
    *(0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28),
    *(31, 32, 29, 30, 19, 20, 17, 18),
)
"""MediaPipe landmarks in the order of ``KEY_POINTS``."""
_SECONDS_PER_IMAGE, _SECONDS_TO_START = 10.0, 120.0


class MediaPipe:
    """MediaPipe's pose detector, run in another Python environment; it detects one person per
    image."""

    name = "MediaPipe"

    def __init__(self, python: Path | None = None) -> None:
        """``python`` is the interpreter of that environment; None: ``$DYNGS_MEDIAPIPE``. Raises
        DyngsError: it does not exist."""
        from_environment = os.environ.get(MEDIAPIPE_VARIABLE, "")
        chosen = python or (Path(from_environment).expanduser() if from_environment else None)
        if chosen is None:
            raise DyngsError(
                f"no person detector: install MediaPipe with {INSTALL_HINT}; {MASKS_HINT}"
            )
        if not chosen.is_file():
            raise DyngsError(
                f"{chosen}: no such Python interpreter; install MediaPipe with {INSTALL_HINT}"
            )
        self._python = chosen

    def detect(self, images: Sequence[Path]) -> list[Detection | None]:
        if not images:
            return []
        with tempfile.TemporaryDirectory(prefix="dyngs-mediapipe-") as out:
            self._run(
                images[0].parent, Path(out), _SECONDS_TO_START + _SECONDS_PER_IMAGE * len(images)
            )
            return [_read(Path(out) / f"{image.stem}.npz") for image in images]

    def _run(self, images: Path, out: Path, seconds: float) -> None:
        # -I keeps packages of dyngs's environment (PYTHONPATH, current folder) out of this process.
        command = [str(self._python), "-I", str(mediapipe_worker.__file__), str(images), str(out)]
        environment = {**os.environ, "GLOG_minloglevel": "3", "TF_CPP_MIN_LOG_LEVEL": "3"}
        try:
            process = subprocess.run(
                command,
                env=environment,
                capture_output=True,
                text=True,
                timeout=seconds,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise DyngsError(
                f"{self._python}: MediaPipe did not finish in {seconds:.0f} s; use fewer frames"
            ) from None
        except OSError as error:
            raise DyngsError(f"cannot start {self._python}: {error.strerror or error}") from error
        if process.returncode == mediapipe_worker.NO_MEDIAPIPE:
            raise DyngsError(
                f"{self._python}: {_last_line(process.stderr)}; install it with "
                f"`{quote_path(self._python)} -m pip install {MEDIAPIPE_PACKAGE}`"
            )
        if process.returncode:
            raise DyngsError(
                f"{self._python}: MediaPipe failed with exit status {process.returncode}: "
                f"{_last_line(process.stderr)}"
            )


def _last_line(output: str) -> str:
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    return lines[-1][:200] if lines else "no error output"


def _read(path: Path) -> Detection | None:
    if not path.is_file():
        return None
    arrays = read_arrays(path, lambda _: ("landmarks", "positions", "mask"))
    rows = list(LANDMARKS)
    keypoints, positions = (
        arrays[name][rows].astype(np.float32) for name in ("landmarks", "positions")
    )
    return Detection(keypoints, arrays["mask"], positions)
