"""Writing H.264 MP4 videos with PyAV."""

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
    """Encode images as MP4 for any player: H.264, yuv420p, BT.709, constant frame rate.

    Yields the function that appends an image (H, W, 3) uint8; all have the size of the first. The
    file appears when the block ends without an error; otherwise (or without any image) there is
    none, and an earlier one stays. Images of odd width or height are padded by repeating the last
    column or row. ``quality``: x264's constant rate factor, 0 (lossless) to 51; 18 is visually
    lossless.

        with video_writer(Path("orbit.mp4"), fps=30) as add:
            add(rgb)
    """
    import av
    from av.error import FFmpegError
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

    if not 0 < fps <= 1000:
        raise DyngsError(f"cannot write {path}: fps must be in (0, 1000], got {fps:g}")
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
            stream.thread_count = 1  # the bytes depend on their number
            stream.options = {"crf": str(quality), "preset": "medium"}
            stream.codec_context.colorspace = int(Colorspace.ITU709)
            stream.codec_context.color_range = int(ColorRange.MPEG)
            stream.codec_context.color_primaries = ColorPrimaries.BT709
            stream.codec_context.color_trc = ColorTrc.BT709
        if (height, width) != (stream.height, stream.width):
            raise ValueError(
                f"image {count} has another size, {width}x{height}, than the first one"
            )
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
                    raise DyngsError(f"cannot write {path}: the video has no images")
                container.mux(stream.encode(None))
        except (FFmpegError, OSError, ValueError) as error:
            raise DyngsError(
                f"cannot write the video {path} ({error}); use the suffix .mp4, and a PyAV that has libx264"
            ) from error
