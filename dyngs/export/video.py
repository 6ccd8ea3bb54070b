"""Writing H.264 MP4 videos with PyAV."""

from __future__ import annotations

from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.io.write import atomic_file


class VideoWriter:
    """Context manager that encodes images as MP4 for any player: H.264, yuv420p, BT.709, constant
    frame rate.

    The file appears when the block ends without an error; otherwise (or without any image) there is
    none, and an earlier one stays. Images of odd width or height are padded by repeating the last
    column or row.

        with VideoWriter(Path("orbit.mp4"), fps=30) as video:
            video.add(rgb)
    """

    def __init__(self, path: Path, fps: float = 30.0, quality: int = 18) -> None:
        """Prepare a writer; nothing is written yet.

        ``fps`` is more than 0; ``quality`` x264's constant rate factor, 0 (lossless) to 51; 18 is
        visually lossless.
        """
        if not 0 < fps <= 1000:
            raise DyngsError(f"cannot write {path}: fps must be in (0, 1000], got {fps:g}")
        self.path = path
        self._rate = Fraction(fps).limit_denominator(1001)
        self._quality = quality
        self._num_frames = 0
        self._size: tuple[int, ...] = ()
        self._stack = ExitStack()
        self._container: Any = None
        self._stream: Any = None

    def __enter__(self) -> VideoWriter:
        import av

        with ExitStack() as stack:
            temporary = stack.enter_context(atomic_file(self.path))
            try:
                self._container = stack.enter_context(av.open(str(temporary), "w"))
            except (OSError, ValueError) as error:
                raise self._error(error) from error
            self._stack = stack.pop_all()
        return self

    def add(self, rgb: np.ndarray) -> None:
        """Append an image (H, W, 3) uint8; all must have the size of the first."""
        height, width = rgb.shape[:2]
        rgb = np.pad(rgb, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        if self._stream is None:
            self._size = rgb.shape
            self._open()
        if rgb.shape != self._size:
            raise ValueError(f"all images of a video must have the size {self._size}")
        self._encode(rgb)
        self._num_frames += 1

    def __exit__(self, *problem: Any) -> None:
        with self._stack:  # an error in here removes the file
            if problem[1] is not None:
                raise problem[1]
            if self._stream is None:
                raise DyngsError(f"cannot write {self.path}: the video has no images")
            self._encode(None)

    def _open(self) -> None:
        from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

        try:
            stream = self._container.add_stream("libx264", rate=self._rate)
        except (OSError, ValueError) as error:
            raise self._error(error) from error
        stream.height, stream.width = self._size[:2]
        stream.pix_fmt = "yuv420p"
        stream.thread_count = 1  # the bytes depend on their number
        stream.options = {"crf": str(self._quality), "preset": "medium"}
        context = stream.codec_context
        context.colorspace = int(Colorspace.ITU709)
        context.color_range = int(ColorRange.MPEG)
        context.color_primaries = ColorPrimaries.BT709
        context.color_trc = ColorTrc.BT709
        self._stream = stream

    def _encode(self, rgb: np.ndarray | None) -> None:
        """Encode an image; None flushes the encoder."""
        import av
        from av.error import FFmpegError

        context = self._stream.codec_context
        try:
            frame = None
            if rgb is not None:
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
                frame = frame.reformat(
                    format="yuv420p",
                    dst_colorspace=context.colorspace,
                    dst_color_range=context.color_range,
                    interpolation="AREA",
                )
                frame.pts = self._num_frames
                frame.time_base = 1 / context.framerate
            self._container.mux(self._stream.encode(frame))
        except (FFmpegError, OSError) as error:
            raise self._error(error) from error

    def _error(self, error: Exception) -> DyngsError:
        return DyngsError(
            f"cannot write the video {self.path} ({error}); use the suffix .mp4, and a PyAV that has libx264"
        )
