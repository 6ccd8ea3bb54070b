"""MediaPipe in another environment, whose interpreter is replaced by a script here."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from dyngs.core.errors import DyngsError
from dyngs.human.detect.detector import LANDMARKS, MEDIAPIPE_VARIABLE, MediaPipe
from dyngs.io.write import write_image

SCRIPT = """#!{python}
import sys
from pathlib import Path
import numpy as np
isolated, worker, images, out = sys.argv[1:]
assert isolated == "-I" and worker.endswith("mediapipe_worker.py")
{body}
"""
FINDS = """
for number, path in enumerate(sorted(Path(images).glob("*.png"))):
    if number != 1:
        landmarks = np.stack([np.arange(33), np.full(33, number), np.full(33, 0.5)], 1)
        mask = np.full((4, 6), 200, np.uint8)
        np.savez(Path(out) / f"{path.stem}.npz", landmarks=landmarks, positions=-landmarks, mask=mask)
"""


def interpreter(folder: Path, body: str) -> Path:
    path = folder / "python"
    path.write_text(SCRIPT.format(python=sys.executable, body=body))
    path.chmod(0o755)
    return path


@pytest.fixture
def images(tmp_path: Path) -> list[Path]:
    files = [tmp_path / "images" / f"{row:06d}.png" for row in range(3)]
    for file in files:
        write_image(file, np.zeros((4, 6, 3), np.uint8))
    return files


@pytest.mark.skipif(
    os.name != "posix", reason="the interpreter is replaced by a script with a #! line"
)
def test_detections_of_the_process_are_returned(tmp_path: Path, images: list[Path]) -> None:
    first, second, third = MediaPipe(interpreter(tmp_path, FINDS)).detect(images)
    assert second is None
    assert first is not None
    assert third is not None
    np.testing.assert_array_equal(first.keypoints[:, 0], LANDMARKS)
    np.testing.assert_array_equal(third.keypoints[:, 1], 2)
    np.testing.assert_array_equal(third.positions, -third.keypoints)
    np.testing.assert_array_equal(first.box, [0, 0, 6, 4])
    assert MediaPipe(interpreter(tmp_path, FINDS)).detect([]) == []


@pytest.mark.skipif(
    os.name != "posix", reason="the interpreter is replaced by a script with a #! line"
)
@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("sys.exit('out of memory')", "MediaPipe failed with exit status 1: out of memory"),
        ("sys.exit(7)", "MediaPipe failed with exit status 7: no error output"),
        (
            "for x in Path(images).iterdir(): "
            "(Path(out) / f'{x.stem}.npz').write_bytes(b'rubbish')",
            "damaged",
        ),
    ],
)
def test_failures_are_one_line(tmp_path: Path, images: list[Path], body: str, said: str) -> None:
    with pytest.raises(DyngsError) as raised:
        MediaPipe(interpreter(tmp_path, body)).detect(images)
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_an_environment_without_it_is_named(images: list[Path]) -> None:
    if _has_mediapipe():
        pytest.skip("MediaPipe is installed beside dyngs")
    with pytest.raises(DyngsError, match=r"No module named .*pip install mediapipe=="):
        MediaPipe(Path(sys.executable)).detect(images)


def _has_mediapipe() -> bool:
    from importlib.util import find_spec

    return find_spec("mediapipe") is not None and find_spec("cv2") is not None


@pytest.mark.skipif(
    MEDIAPIPE_VARIABLE not in os.environ,
    reason=f"{MEDIAPIPE_VARIABLE} names no environment with MediaPipe",
)
def test_the_real_one_finds_nobody_in_noise(tmp_path: Path) -> None:
    path = tmp_path / "noise" / "000000.png"
    write_image(path, np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8))
    assert MediaPipe().detect([path]) == [None]
