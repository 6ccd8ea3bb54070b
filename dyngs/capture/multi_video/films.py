"""Videos of a folder, small grey images of them, whether cameras stand still, and what
``videos.json`` says."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from dyngs.core.conventions import ReportProgress, report_nothing
from dyngs.core.errors import DyngsError
from dyngs.data.images.video import VideoInfo, frame_seconds, probe_video, read_frames
from dyngs.data.times import evenly_spaced
from dyngs.io.fields import first_few, is_number, read_json_object

SMALL_SIDE = 160  # longer side of the small images, px
SMALL_BYTES = 400_000_000  # memory that the small images of all videos take at most


@dataclass(frozen=True)
class Film:
    """A video of the camera ``name``, with ``seconds`` (F,) when each frame is shown, the first one
    at 0."""

    name: str
    path: Path
    info: VideoInfo
    seconds: np.ndarray

    @property
    def rate(self) -> float:
        """Frames per second, by the times of the frames."""
        gaps = np.diff(self.seconds)
        return (
            float(1 / np.median(gaps))
            if len(gaps) and np.median(gaps) > 0
            else self.info.fps or 30.0
        )


def open_film(path: Path) -> Film:
    """Return a video."""
    info = probe_video(path)
    return Film(path.stem, path, info, np.array(frame_seconds(path, info.num_frames)))


def small_images(
    films: Sequence[Film], report: ReportProgress = report_nothing
) -> list[np.ndarray]:
    """Return small grey images (F, H, W) uint8 of all videos, of the first frames where all would
    take too much."""
    limit = SMALL_BYTES // max(len(films) * SMALL_SIDE * SMALL_SIDE, 1)
    images = []
    for number, film in enumerate(films):
        shown = [shrunk_grey(rgb) for rgb in islice(read_frames(film.path), limit)]
        images.append(
            np.stack(shown[: len(film.seconds)]) if shown else np.zeros((0, 1, 1), np.uint8)
        )
        report("videos looked at", number + 1, len(films))
    return images


def shrunk_grey(rgb: np.ndarray) -> np.ndarray:
    """Return (h, w) uint8: means of the green of (H, W, 3) uint8 over square blocks, ``SMALL_SIDE``
    px long at most."""
    step = max(math.ceil(max(rgb.shape[:2]) / SMALL_SIDE), 1)
    height, width = (max(size // step, 1) for size in rgb.shape[:2])
    blocks = rgb[: height * step, : width * step, 1].reshape(
        height, min(step, rgb.shape[0]), width, -1
    )
    return np.round(
        blocks.sum(axis=(1, 3), dtype=np.uint32) / (blocks.shape[1] * blocks.shape[3])
    ).astype(np.uint8)


VIDEOS_FILE = "videos.json"
MAX_SECONDS = 86_400.0


def read_given(
    folder: Path, names: Sequence[str]
) -> tuple[dict[str, float] | None, tuple[str, ...] | None]:
    """Return when the videos begin, by camera, in one clock, and the cameras for testing; None: not
    known.

    By ``videos.json``: ``{"starts": {"cam00": 0, "cam01": 1.25}, "test": ["cam00"]}``; all keys are
    optional.

    ``"starts": 0`` says that all videos begin at once. Raises DyngsError: a camera that is not
    there or missing, or something that is no number.
    """
    path = folder / VIDEOS_FILE
    if not path.is_file():
        return None, None
    fields = read_json_object(path)
    unknown = sorted(fields.keys() - {"starts", "test"})
    if unknown:
        raise DyngsError(f"{path}: unknown key {unknown[0]!r:.60}; there are 'starts' and 'test'")
    test = fields.get("test")
    if test is not None and not (isinstance(test, list) and all(name in names for name in test)):
        raise DyngsError(
            f"{path}: 'test' must list cameras of {first_few(sorted(names))}, got {test!r:.80}"
        )
    if test is not None and set(test) == set(names):
        raise DyngsError(f"{path}: 'test' names all cameras, which leaves none to train on")
    starts = fields.get("starts")
    if starts == 0 and is_number(starts):
        starts = dict.fromkeys(names, 0.0)
    elif starts is not None and not isinstance(starts, dict):
        raise DyngsError(
            f"{path}: 'starts' must map cameras to seconds, or be 0, got {starts!r:.40}"
        )
    seconds = None if starts is None else checked_starts(starts, names, str(path))
    return seconds, None if test is None else tuple(test)


def checked_starts(
    starts: Mapping[str, object], names: Sequence[str], where: str
) -> dict[str, float]:
    """Return the seconds at which the videos begin, for every camera.

    Raises DyngsError: a camera that is not there or missing, or something that is no number of at
    most a day.
    """
    unknown = sorted(starts.keys() - set(names))
    missing = sorted(set(names) - starts.keys())
    if unknown:
        raise DyngsError(
            f"{where}: no video is called {first_few(unknown)}; there are {first_few(sorted(names))}"
        )
    if missing:
        raise DyngsError(
            f"{where}: says nothing on {first_few(missing)}; give the second at which every video begins"
        )
    seconds: dict[str, float] = {}
    for name, second in starts.items():
        if not (is_number(second) and math.isfinite(second) and abs(second) <= MAX_SECONDS):
            raise DyngsError(
                f"{where}: the start of {name} must be a number of seconds, got {second!r:.40}"
            )
        seconds[name] = float(second)
    return seconds


STANDS = 0.002
"""A camera stands if its image is never displaced by more than this fraction of its longer side."""
SAMPLES = 16  # images that are compared with the typical one
_ITERATIONS = 16
_TOLD, _FLAT = 0.4, 1.0
"""Pixels that are looked at: this fraction of them, where the image changes most, by so many grey
levels per pixel."""
# grey levels of the Cauchy weights in the first rounds, and in the later ones
_SCALES = (40.0, 20.0, 10.0, 5.0, 3.0)
_MOST_PIXELS = 0.5  # fraction of those pixels that must fit the displacement: so much stands
_FITS = 12.0  # grey levels within which they fit


def displaced_by(grey: np.ndarray) -> float:
    """Return how far the images (F, H, W) uint8 of a video are displaced against their median; see
    ``STANDS``.

    In fractions of the longer side; infinite where they have too little in common to tell. An
    affine displacement and a change of brightness are fitted to what most pixels show (iterated
    least squares with Cauchy weights), so that what moves before a fixed camera does not count. A
    camera that jumps far leaves no sharp median, and does not fit.
    """
    if len(grey) < 2:
        return 0.0
    chosen = [grey[i].astype(np.float64) for i in evenly_spaced(len(grey), SAMPLES)]
    typical = np.median(chosen, axis=0)
    if float(np.hypot(*np.gradient(typical)).max(initial=0.0)) < 2.0:
        # nothing could tell a displacement
        return 0.0
    moved = [displacement(typical, image) for image in chosen]
    # A single image may be spoiled, by a flash or a hand before the lens.
    return float(np.quantile(moved, 0.95, method="lower"))


def displacement(one: np.ndarray, other: np.ndarray) -> float:
    """Return the largest displacement of a corner between two images (H, W), in fractions of the
    longer side.

    Infinite where fewer than half of the pixels that tell fit it.
    """
    height, width = one.shape
    rows, columns = np.mgrid[0:height, 0:width]
    x = (columns - width / 2) / max(width, height)
    y = (rows - height / 2) / max(width, height)
    slope = np.hypot(*np.gradient(one))
    # even areas fit any displacement
    told = slope >= max(float(np.quantile(slope, 1 - _TOLD)), _FLAT)
    if not told.any():
        return np.inf
    parameters = np.zeros(6)
    residual = np.zeros(0)
    for round_number in range(_ITERATIONS):
        flow_x, flow_y = _flow(parameters, x, y)
        moved, is_inside = _sampled(other, columns + flow_x, rows + flow_y)
        used = is_inside & told
        if used.sum() < told.sum() / 4:
            return np.inf
        gradient_y, gradient_x = np.gradient(moved)
        along = (
            gradient_x,
            gradient_x * x,
            gradient_x * y,
            gradient_y,
            gradient_y * x,
            gradient_y * y,
            1 + 0 * x,
        )
        terms = np.stack([term[used] for term in along])
        residual = (one - moved)[used]
        residual = residual - np.median(residual)
        scale = max(
            1.4826 * float(np.median(np.abs(residual))),
            _SCALES[min(round_number, len(_SCALES) - 1)],
        )
        weights = 1 / (1 + (residual / scale) ** 2)
        step = np.linalg.solve(
            (terms * weights) @ terms.T + 1e-3 * np.eye(7), (terms * weights) @ residual
        )
        parameters += step[:6]
        if round_number >= len(_SCALES) and np.abs(step[:6]).max() < 1e-3:
            break
    if float((np.abs(residual) < _FITS).mean()) < _MOST_PIXELS:
        return np.inf
    at_x, at_y = (
        np.array(corners) * size / max(width, height)
        for corners, size in (((-0.5, 0.5, -0.5, 0.5), width), ((-0.5, -0.5, 0.5, 0.5), height))
    )
    flow_x, flow_y = _flow(parameters, at_x, at_y)
    return float(np.hypot(flow_x, flow_y).max() / max(width, height))


def _flow(parameters: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a = parameters
    return a[0] + a[1] * x + a[2] * y, a[3] + a[4] * x + a[5] * y


def _sampled(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the image at places in px, bilinear, and which of them lie inside."""
    height, width = image.shape
    is_inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    return map_coordinates(image, [y, x], order=1, mode="nearest"), is_inside
