"""H.264 MP4 videos written with PyAV."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.io.write import atomic_file


@contextmanager
def video_writer(
    path: Path, fps: float = 30.0, quality: int = 18
) -> Iterator[Callable[[np.ndarray], None]]:
    """Encode images as an MP4 video: H.264, yuv420p, BT.709, constant frame rate.

    Yields a function that appends an image (H, W, 3) uint8. All images have the size of the first.
    Odd sizes are padded by repeating the last row or column. The file is created when the block
    ends without an error. Otherwise an existing file is kept.

        with video_writer(Path("orbit.mp4"), fps=30) as add:
            add(rgb)

    Args:
        quality: constant rate factor of x264, 0 (lossless) to 51. 18 is visually lossless.
    """
    import av
    from av.error import FFmpegError
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

    if not 0 < fps <= 1000:
        raise DyngsError(f"cannot write {path}: fps must be in (0, 1000], not {fps:g}")
    stream: Any = None
    count = 0

    def add(rgb: np.ndarray) -> None:
        nonlocal stream, count
        height, width = rgb.shape[:2]
        rgb = np.pad(rgb, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        height, width = rgb.shape[:2]
        if stream is None:
            stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
            stream.height, stream.width = height, width
            stream.pix_fmt = "yuv420p"
            stream.thread_count = 1  # the output depends on the number of threads
            stream.options = {"crf": str(quality), "preset": "medium"}
            stream.codec_context.colorspace = int(Colorspace.ITU709)
            stream.codec_context.color_range = int(ColorRange.MPEG)
            stream.codec_context.color_primaries = ColorPrimaries.BT709
            stream.codec_context.color_trc = ColorTrc.BT709
        if (height, width) != (stream.height, stream.width):
            raise ValueError(f"image {count} has size {width}x{height}, unlike the first one")
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
        frame = frame.reformat(
            format="yuv420p",
            dst_colorspace=stream.codec_context.colorspace,
            dst_color_range=stream.codec_context.color_range,
            interpolation="AREA",
        )
        frame.pts = count
        frame.time_base = 1 / stream.codec_context.framerate
        container.mux(stream.encode(frame))
        count += 1

    with atomic_file(path) as temporary:
        try:
            with av.open(str(temporary), "w") as container:
                yield add
                if stream is None:
                    raise DyngsError(f"cannot write {path}: no images")
                container.mux(stream.encode(None))
        except (FFmpegError, OSError, ValueError) as error:
            raise DyngsError(
                f"cannot write video {path} ({error}); use .mp4, and PyAV with libx264"
            ) from error
