"""MediaPipe's pose detector, in a process of its own environment: it wants another NumPy than
dyngs.

BlazePose (Bazarevsky et al. 2020): 33 landmarks and a silhouette of one person, who is followed
from image to image. The package brings its models with it.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dyngs.core.errors import DyngsError, as_word
from dyngs.human.detect import mediapipe_worker
from dyngs.human.detect.detector import Detection
from dyngs.io.numpy_files import read_arrays

VARIABLE = "DYNGS_MEDIAPIPE"
"""Environment variable: the Python interpreter of an environment with MediaPipe."""
PACKAGE = "mediapipe==0.10.21"
"""The last version that has its models in its wheel and needs no download when it runs."""
INSTALL = (
    f"`python -m venv ENV && ENV/bin/pip install {PACKAGE}` (Python 3.9 to 3.12), then give --mediapipe ENV/bin/python "
    f"or set {VARIABLE} to it"
)
OTHERS = "or give masks of another program to `dyngs data fit` (docs/person.md)"
LANDMARKS = (0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28)
"""Rows of MediaPipe's landmarks that are the key points of COCO, in their order."""
_SECONDS_PER_IMAGE, _SECONDS_TO_START = 10.0, 120.0


class MediaPipe:
    """MediaPipe's pose detector in another Python environment; it finds one person in an image."""

    name = "MediaPipe"

    def __init__(self, python: Path | None = None) -> None:
        """``python``: the interpreter of that environment; None: ``$DYNGS_MEDIAPIPE``. Raises
        DyngsError: not there."""
        named = os.environ.get(VARIABLE, "")
        chosen = python or (Path(named).expanduser() if named else None)
        if chosen is None:
            raise DyngsError(
                f"no detector finds the person: install MediaPipe with {INSTALL}; {OTHERS}"
            )
        if not chosen.is_file():
            raise DyngsError(
                f"{chosen}: no such Python interpreter; install MediaPipe with {INSTALL}"
            )
        self._python = chosen

    def detect(self, images: Sequence[Path]) -> list[list[Detection]]:
        """Return at most one person per image; the images must lie in one folder that holds no
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
                f"`{as_word(self._python)} -m pip install {PACKAGE}`"
            )
        if done.returncode:
            raise DyngsError(
                f"{self._python}: MediaPipe failed ({done.returncode}): {_last_line(done.stderr)}"
            )


def _last_line(said: str) -> str:
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    return lines[-1][:200] if lines else "nothing was said"


def _read(path: Path) -> list[Detection]:
    if not path.is_file():
        return []
    arrays = read_arrays(path, lambda _: ("landmarks", "mask"))
    return [Detection(arrays["landmarks"][list(LANDMARKS)].astype(np.float32), arrays["mask"])]
