"""Videos of a folder: what they are, and small grey images of them that motion is measured in."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dyngs.conventions import ReportProgress, report_nothing
from dyngs.data.images.video import VIDEO_SUFFIXES, VideoInfo, frame_seconds, probe_video, read_frames
from dyngs.errors import DyngsError, reading
from dyngs.files.containment import inside

SMALL_SIDE = 160
"""Longer side of the small images, px."""
SMALL_BYTES = 400_000_000
"""Memory that the small images of all videos take at most."""


@dataclass(frozen=True)
class Film:
    """A video of one camera.

    Attributes:
        name: of the camera: the file's name without its suffix.
        path: the file.
        info: size, length, frame rate.
        seconds: (F,) when each frame is shown, the first one at 0.
    """

    name: str
    path: Path
    info: VideoInfo
    seconds: np.ndarray

    @property
    def rate(self) -> float:
        """Frames per second, by the times of the frames."""
        gaps = np.diff(self.seconds)
        return float(1 / np.median(gaps)) if len(gaps) and np.median(gaps) > 0 else self.info.fps or 30.0


@dataclass(frozen=True)
class SmallImages:
    """Small grey images of the beginning of a video.

    Attributes:
        grey: (F, H, W) uint8.
        seconds: (F,) as in ``Film``.
    """

    grey: np.ndarray
    seconds: np.ndarray


def videos_in(folder: Path) -> list[Path]:
    """Return the videos directly in a folder, by name; hidden files are left out.

    Raises:
        DyngsError: two with the same name but for the suffix.
    """
    with reading(folder, "choose another folder or change its permissions"):
        videos = sorted(
            path
            for path in folder.iterdir()
            if path.suffix.lower() in VIDEO_SUFFIXES and path.is_file() and not path.name.startswith(".")
        )
    names: dict[str, Path] = {}
    for path in videos:
        if names.setdefault(path.stem, path) != path:
            raise DyngsError(f"{folder}: {names[path.stem].name} and {path.name} are one camera; remove one of them")
    return videos


def open_films(folder: Path) -> list[Film]:
    """Return the videos of a folder, by name.

    Raises:
        DyngsError: one of them cannot be read.
    """
    return [open_film(inside(path)) for path in videos_in(folder)]


def open_film(path: Path) -> Film:
    """Return a video.

    Raises:
        DyngsError: it cannot be read.
    """
    info = probe_video(path)
    return Film(path.stem, path, info, np.array(frame_seconds(path, info.num_frames)))


def small_images(films: Sequence[Film], report: ReportProgress = report_nothing) -> list[SmallImages]:
    """Return small grey images of all videos, of the first frames where all would take too much memory.

    Args:
        films: the videos.
        report: is told of each video.

    Raises:
        DyngsError: damage in a video.
    """
    limit = SMALL_BYTES // max(len(films) * SMALL_SIDE * SMALL_SIDE, 1)
    images = []
    for number, film in enumerate(films):
        shown = [shrunk_grey(rgb) for rgb in _first(read_frames(film.path), limit)]
        grey = np.stack(shown[: len(film.seconds)]) if shown else np.zeros((0, 1, 1), np.uint8)
        images.append(SmallImages(grey, film.seconds[: len(grey)]))
        report("videos looked at", number + 1, len(films))
    return images


def shrunk_grey(rgb: np.ndarray, side: int = SMALL_SIDE) -> np.ndarray:
    """Return (h, w) uint8: means of the green of (H, W, 3) uint8 over square blocks, ``side`` px long at most."""
    step = max(math.ceil(max(rgb.shape[:2]) / side), 1)
    height, width = (max(size // step, 1) for size in rgb.shape[:2])
    blocks = rgb[: height * step, : width * step, 1].reshape(height, min(step, rgb.shape[0]), width, -1)
    return np.round(blocks.sum(axis=(1, 3), dtype=np.uint32) / (blocks.shape[1] * blocks.shape[3])).astype(np.uint8)


def _first(frames: Iterator[np.ndarray], count: int) -> Iterator[np.ndarray]:
    for number, rgb in enumerate(frames):
        if number >= count:
            return
        yield rgb
