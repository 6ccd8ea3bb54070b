"""Writing H.264 MP4 videos with PyAV."""

from __future__ import annotations

import os
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.io.temporary import temporary_beside
from dyngs.io.write import require_replaceable


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
        self.path, self.fps, self.quality = path, fps, quality
        self.num_frames = 0
        self._size: tuple[int, int] | None = None
        self._temporary: Path | None = None
        self._container: Any = None
        self._stream: Any = None

    def __enter__(self) -> VideoWriter:
        return self

    def add(self, rgb: np.ndarray) -> None:
        """Append an image (H, W, 3) uint8; all must have the size of the first."""
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
            raise ValueError(f"a video image must be (H, W, 3) uint8, got {rgb.shape} {rgb.dtype}")
        if self._size is None:
            self._open(rgb.shape[0], rgb.shape[1])
        if rgb.shape[:2] != self._size:
            raise ValueError(
                f"all images of a video must have one size, got {rgb.shape[:2]} after {self._size}"
            )
        height, width = rgb.shape[:2]
        if height % 2 or width % 2:
            rgb = np.pad(rgb, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        self._encode(rgb)
        self.num_frames += 1

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None and self._container is None:
            raise DyngsError(f"cannot write {self.path}: the video has no images")
        try:
            if kind is None:
                self._encode(None)
                self._close()
                os.replace(self._temporary or self.path, self.path)
        except OSError as problem:
            raise DyngsError(
                f"cannot write the video {self.path}: {problem.strerror or problem}"
            ) from problem
        finally:
            self._discard()

    def _open(self, height: int, width: int) -> None:
        import av
        from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

        rate = Fraction(self.fps).limit_denominator(1001)
        require_replaceable(self.path)
        try:
            self._temporary = temporary_beside(self.path)
            self._container = av.open(str(self._temporary), "w")
            self._stream = self._container.add_stream("libx264", rate=rate)
        except (OSError, ValueError) as error:
            self._discard()
            advice = "" if self.path.suffix == ".mp4" else "; use the suffix .mp4"
            if "libx264" not in av.codecs_available:
                advice = ": this PyAV lacks the H.264 encoder libx264; reinstall it with `pip install av`"
            raise DyngsError(f"cannot write the video {self.path} ({error}){advice}") from error
        self._size = (height, width)
        stream = self._stream
        stream.width = width + width % 2
        stream.height = height + height % 2
        stream.pix_fmt = "yuv420p"
        stream.thread_count = 1  # the bytes depend on their number
        stream.options = {"crf": str(self.quality), "preset": "medium"}
        context = stream.codec_context
        self._colours = int(Colorspace.ITU709), int(ColorRange.MPEG)
        context.colorspace, context.color_range = self._colours
        context.color_primaries = ColorPrimaries.BT709
        context.color_trc = ColorTrc.BT709

    def _encode(self, rgb: np.ndarray | None) -> None:
        """Encode an image; None flushes the encoder."""
        import av
        from av.error import FFmpegError

        try:
            if rgb is None:
                self._container.mux(self._stream.encode(None))
                return
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
            space, extent = self._colours
            frame = frame.reformat(
                format="yuv420p", dst_colorspace=space, dst_color_range=extent, interpolation="AREA"
            )
            frame.pts = self.num_frames
            frame.time_base = 1 / self._stream.codec_context.framerate
            self._container.mux(self._stream.encode(frame))
        except (FFmpegError, OSError) as error:
            raise DyngsError(f"cannot write the video {self.path}: {error}") from error

    def _close(self) -> None:
        container = self._container
        self._container = None
        if container is not None:
            container.close()

    def _discard(self) -> None:
        with suppress(OSError):
            self._close()
        if self._temporary is not None:
            self._temporary.unlink(missing_ok=True)
