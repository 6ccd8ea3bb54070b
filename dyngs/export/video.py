"""Videos written with PyAV: H.264, VP9 and GIF, the last two with transparency."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.io.write import atomic_file

_CODECS = {
    ".mp4": "libx264",
    ".mov": "libx264",
    ".mkv": "libx264",
    ".webm": "libvpx-vp9",
    ".gif": "gif",
}
WRITTEN_SUFFIXES = tuple(_CODECS)
_VP9_QUALITY = 12
"""Added to the rate factor of x264 for VP9, whose scale of 0 to 63 gives similar sizes then."""


def require_video_suffix(path: Path, *, transparent: bool = False) -> None:
    """Raise DyngsError unless ``path`` has the suffix of a video, for transparent frames one that
    holds them."""
    suffix = path.suffix.lower()
    if suffix not in _CODECS:
        raise DyngsError(
            f"{path}: videos are written as {', '.join(_CODECS)}; use {path.stem or 'video'}.mp4"
        )
    if transparent and _CODECS[suffix] == "libx264":
        raise DyngsError(f"{path}: {suffix} has no transparency; use .webm, .gif or images")


@contextmanager
def video_writer(
    path: Path, fps: float = 30.0, quality: int = 18
) -> Iterator[Callable[[np.ndarray], None]]:
    """Encode images as a video with a constant frame rate; the suffix names the format.

    H.264 and VP9 are written as yuv420p in BT.709, GIF with a palette per frame.

    Yields a function that appends an image, (H, W, 3) or (H, W, 4) uint8 with straight alpha. All
    images have the shape of the first. Odd sizes are padded by repeating the last row or column,
    except in a GIF. The file is created when the block ends without an error. Otherwise an existing
    file is kept.

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
    require_video_suffix(path)
    codec = _CODECS[path.suffix.lower()]
    stream: Any = None
    palette: Any = None
    shape: tuple[int, ...] = ()
    count = 0

    def start(height: int, width: int, channels: int) -> Any:
        nonlocal palette
        require_video_suffix(path, transparent=channels == 4)
        stream = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1001))
        stream.height, stream.width = height, width
        stream.thread_count = 1  # the output depends on the number of threads
        if codec == "gif":
            stream.pix_fmt = "pal8"
            # Differences of frames are wrong where their palettes differ.
            stream.options = {"gifflags": "-offsetting-transdiff"}
            palette = _palette_filter(height, width, 1 / stream.codec_context.framerate)
            return stream
        stream.pix_fmt = "yuva420p" if channels == 4 else "yuv420p"
        stream.options = {"crf": str(quality), "preset": "medium"}
        if codec == "libvpx-vp9":
            rate = str(min(quality + _VP9_QUALITY, 63))
            stream.options = {"crf": rate, "b": "0", "deadline": "good", "cpu-used": "4"}
        stream.codec_context.colorspace = int(Colorspace.ITU709)
        stream.codec_context.color_range = int(ColorRange.MPEG)
        stream.codec_context.color_primaries = ColorPrimaries.BT709
        stream.codec_context.color_trc = ColorTrc.BT709
        return stream

    def add(image: np.ndarray) -> None:
        nonlocal stream, shape, count
        if codec != "gif":
            height, width = image.shape[:2]
            image = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        if stream is None:
            shape = image.shape
            stream = start(*shape)
        if image.shape != shape:
            height, width = image.shape[:2]
            raise ValueError(f"image {count} has size {width}x{height}, unlike the first one")
        kind = "rgba" if image.shape[2] == 4 else "rgb24"
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=kind)
        if palette is None:
            frame = frame.reformat(
                format=stream.pix_fmt,
                dst_colorspace=stream.codec_context.colorspace,
                dst_color_range=stream.codec_context.color_range,
                interpolation="AREA",
            )
        frame.pts = count
        frame.time_base = 1 / stream.codec_context.framerate
        if palette is not None:
            palette.push(frame.reformat(format="rgba"))
            frame = palette.pull()
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
            raise DyngsError(f"cannot write video {path} ({error}); PyAV needs {codec}") from error


def _palette_filter(height: int, width: int, time_base: Fraction) -> Any:
    """Return a filter that reduces RGBA frames to 256 colours, each frame to its own."""
    import av
    import av.filter

    graph = av.filter.Graph()
    source = graph.add_buffer(
        width=width, height=height, format=av.VideoFormat("rgba"), time_base=time_base
    )
    split = graph.add("split")
    colours = graph.add("palettegen", "stats_mode=single")
    mapped = graph.add("paletteuse", "new=1")
    sink = graph.add("buffersink")
    source.link_to(split)
    split.link_to(colours, 0, 0)
    split.link_to(mapped, 1, 0)
    colours.link_to(mapped, 0, 1)
    mapped.link_to(sink)
    graph.configure()
    return graph
