"""Pictures out of video files, through PyAV."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dyngs.errors import DyngsError


def read_frames(path: Path) -> Iterator[np.ndarray]:
    """The pictures of a video file in order, (H, W, 3) uint8, turned as its rotation tag says.

    Raises:
        DyngsError: no such file, no video in it, or damage (at the damaged place).
    """
    import av
    from av.error import FFmpegError

    if not path.is_file():
        raise DyngsError(f"no such video file: {path}")
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise DyngsError(f"{path} has no video stream")
            container.streams.video[0].thread_type = "AUTO"
            for frame in container.decode(video=0):
                rgb = frame.to_ndarray(format="rgb24")
                quarter_turns = round(getattr(frame, "rotation", 0) / 90) % 4
                yield np.ascontiguousarray(np.rot90(rgb, quarter_turns))
    except FFmpegError as error:
        raise DyngsError(f"cannot read the video {path}: {error.strerror or error}") from error
