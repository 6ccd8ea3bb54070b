"""Pictures out of video files, through PyAV."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from dyngs.errors import DyngsError

if TYPE_CHECKING:
    import av

VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")


@dataclass(frozen=True)
class VideoInfo:
    """What a video file says about itself.

    Attributes:
        width, height: pixels of a picture, turned as the rotation tag says.
        num_frames: pictures that there should be; those of a truncated file may not all be readable.
        fps: mean pictures per second, 0 if the file does not say.
    """

    width: int
    height: int
    num_frames: int
    fps: float


def read_frames(path: Path) -> Iterator[np.ndarray]:
    """The pictures of a video file in order, (H, W, 3) uint8, turned as its rotation tag says.

    Raises:
        DyngsError: no such file, no video in it, or damage (at the damaged place).
    """
    for _, frame in _decoded(path, "AUTO"):
        yield _turned_rgb(frame)


def read_numbered_frames(path: Path, numbers: Collection[int]) -> Iterator[tuple[int, np.ndarray]]:
    """The pictures of these ``numbers`` (0 is the first of the file) in rising order, as ``read_frames`` gives them.

    One picture is in memory at a time. Nothing behind the last wanted one is decoded; unwanted ones before it are (each
    picture builds on others), but not converted.

    Raises:
        DyngsError: as ``read_frames``; a wanted picture is damaged or missing: names its number.
    """
    wanted = set(numbers)
    left = len(wanted)
    index = -1
    for index, frame in _decoded(path) if left else ():
        if index not in wanted:
            continue
        if frame.is_corrupt:
            raise _broken(path, index, "its data is damaged")
        yield index, _turned_rgb(frame)
        left -= 1
        if left == 0:
            return
    if left:
        raise _broken(path, index + 1, "the video ends there")


def probe_video(path: Path) -> VideoInfo:
    """Size, length and rate of a video file; the first picture is decoded, and the packets are counted.

    Raises:
        DyngsError: no such file, no video in it, or damage at its beginning.
    """
    import av
    from av.error import FFmpegError

    first = next((frame for _, frame in _decoded(path)), None)
    if first is None:
        raise _broken(path, 0, "it holds no picture")
    height, width = _turned_rgb(first).shape[:2]
    counted = hidden = 0
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        promised, fps = stream.frames, float(stream.average_rate or 0)
        try:
            for packet in container.demux(stream):
                counted += packet.size > 0
                hidden += packet.size > 0 and packet.is_discard  # cut off by an edit list: never shown
        except FFmpegError:
            pass  # truncated: what the header promises is what there should be
    return VideoInfo(width, height, max(promised, counted) - hidden, fps)


def _decoded(path: Path, threads: Literal["AUTO", "SLICE"] = "SLICE") -> Iterator[tuple[int, av.VideoFrame]]:
    """Number and frame, in order; damage ends it with an error that names the number reached.

    With "AUTO", which is faster, several frames are decoded at once, and damage takes those before it along.
    """
    import av
    from av.error import FFmpegError

    if not path.is_file():
        raise DyngsError(f"no such video file: {path}")
    index = 0
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise DyngsError(f"{path} has no video stream")
            container.streams.video[0].thread_type = threads
            for frame in container.decode(video=0):
                yield index, frame
                index += 1
    except FFmpegError as error:
        if index == 0:
            raise DyngsError(f"cannot read the video {path}: {error.strerror or error}") from error
        raise _broken(path, index, error.strerror or str(error)) from error


def _broken(path: Path, index: int, reason: str) -> DyngsError:
    return DyngsError(
        f"the video {path} breaks at frame {index} ({reason}); copy it again, or choose data.frames without that part"
    )


def _turned_rgb(frame: av.VideoFrame) -> np.ndarray:
    rgb = frame.to_ndarray(format="rgb24")
    quarter_turns = round(getattr(frame, "rotation", 0) / 90) % 4
    return np.ascontiguousarray(np.rot90(rgb, quarter_turns))
