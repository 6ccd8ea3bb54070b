"""Video files: decoding with PyAV, colour conversion to sRGB, and a cache of frames as image
files."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
import struct
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from dyngs.core.conventions import decode_srgb, encode_srgb
from dyngs.core.errors import DyngsError, describe_error, format_count, wrap_read_errors
from dyngs.data.capture import VideoFrame
from dyngs.data.images.images import list_files, rotate_upright
from dyngs.io.containment import check_inside, check_size, require_at_most, scaled_limit
from dyngs.io.fields import read_limited
from dyngs.io.outputs import VIDEO_SUFFIXES as VIDEO_SUFFIXES
from dyngs.io.write import cache_folder, write_image, write_text

if TYPE_CHECKING:
    import av
    from av.container import InputContainer
    from av.video.codeccontext import VideoCodecContext


UNSPECIFIED = 2
BT2020, _DISPLAY_P3 = 9, 12
_PQ, _HLG = 16, 18

_TO_BT709 = {
    BT2020: (
        (1.660491, -0.587641, -0.072850),
        (-0.124550, 1.132900, -0.008349),
        (-0.018151, -0.100579, 1.118730),
    ),
    _DISPLAY_P3: (
        (1.224940, -0.224940, 0.0),
        (-0.042057, 1.042057, 0.0),
        (-0.019638, -0.078636, 1.098274),
    ),
}
"""Matrices from linear RGB of other primaries (same white point) to BT.709."""

_REFERENCE_WHITE = 203.0  # cd/m2 of diffuse white in PQ, by BT.2408
_HLG_WHITE = 0.75  # signal of diffuse white in HLG, by BT.2408
_LEVELS = 65535
_ROWS = 32  # rows that are converted at a time: they fit into caches


@dataclass(frozen=True)
class ColourTags:
    """Colour tags of an image: code points of ITU-T H.273, and whether its range is full."""

    primaries: int = UNSPECIFIED
    transfer: int = UNSPECIFIED
    matrix: int = UNSPECIFIED
    is_full_range: bool = False

    def or_else(self, other: ColourTags) -> ColourTags:
        """Return these tags with unspecified ones taken from ``other``."""
        return ColourTags(
            other.primaries if self.primaries == UNSPECIFIED else self.primaries,
            other.transfer if self.transfer == UNSPECIFIED else self.transfer,
            other.matrix if self.matrix == UNSPECIFIED else self.matrix,
            self.is_full_range or other.is_full_range,
        )

    @property
    def gamut(self) -> int:
        """The primaries; BT.2020 for untagged HDR."""
        is_hdr = self.transfer in (_PQ, _HLG)
        return BT2020 if is_hdr and self.primaries == UNSPECIFIED else self.primaries

    @property
    def conversion(self) -> str:
        """Description of the conversion by ``to_srgb``; "" if the colours are sRGB already."""
        if self.transfer == _HLG:
            return f"HLG is tone-mapped to SDR (white: {_HLG_WHITE:.0%} of the signal; brighter is clipped)"
        if self.transfer == _PQ:
            return (
                f"PQ is tone-mapped to SDR (white: {_REFERENCE_WHITE:g} cd/m2; brighter is clipped)"
            )
        name = {BT2020: "BT.2020", _DISPLAY_P3: "Display P3"}.get(self.primaries)
        return f"colours are converted from {name} to BT.709" if name else ""


def to_srgb(pixels: np.ndarray, tags: ColourTags, white: int = _LEVELS) -> np.ndarray:
    """Convert (H, W, 3) uint16 RGB with levels from 0 to ``white`` to uint8 sRGB.

    Values above diffuse white are clipped. The system gamma of HLG is not applied, as in the
    scene-light mapping of BT.2408, so SDR images that were encoded as HLG are restored.
    """
    matrix = _LEVELS * np.array(_TO_BT709.get(tags.gamut, np.eye(3)), np.float32).T
    encoded = np.empty(pixels.shape, np.uint8)
    for begin in range(0, len(pixels), _ROWS):
        rows = slice(begin, begin + _ROWS)
        linear = _linear_table(tags.transfer, white).take(pixels[rows]) @ matrix
        _srgb_table().take(linear.astype(np.int32), out=encoded[rows], mode="clip")
    return encoded


@lru_cache
def _linear_table(transfer: int, white: int) -> np.ndarray:
    """Return the linear light of every 16-bit level of a transfer curve, 1 = diffuse white."""
    signal = np.minimum(np.arange(_LEVELS + 1) / white, 1.0)
    if transfer == _HLG:
        linear = _hlg_linear(signal) / _hlg_linear(np.array(_HLG_WHITE))
    elif transfer == _PQ:
        linear = _pq_linear(signal) * 10_000 / _REFERENCE_WHITE
    else:
        linear = decode_srgb(signal)
    return linear.astype(np.float32)


def _hlg_linear(signal: np.ndarray) -> np.ndarray:
    """Inverse OETF of HLG (BT.2100 table 5): scene light."""
    a = 0.17883277
    b = 0.28466892
    c = 0.55991073
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)


def _pq_linear(signal: np.ndarray) -> np.ndarray:
    """EOTF of PQ (BT.2100 table 4): light in 10,000 cd/m2."""
    power = signal ** (1 / 78.84375)
    return (np.maximum(power - 0.8359375, 0.0) / (18.8515625 - 18.6875 * power)) ** (
        1 / 0.1593017578125
    )


@lru_cache
def _srgb_table() -> np.ndarray:
    """Return the 8-bit sRGB level of linear light in 65,536 steps."""
    return np.round(255 * encode_srgb(np.arange(_LEVELS + 1) / _LEVELS)).astype(np.uint8)


MAX_FRAMES = 1_000_000  # limit on the frames of one video: ten hours
_CONTAINERS = (
    "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,m4v,flv,ogg,asf,dv,mxf,h264,hevc"
)
"""FFmpeg's names of containers that hold the images themselves, whatever the file suffix."""


DECODER_VERSION = b"2"
"""Version of the frame conversion; a change invalidates cached frames."""
_FULL_RANGE = 2  # FFmpeg's number of a range from 0 to the largest level
BT709_MATRIX, BT601_MATRIX, BT2020_MATRIX = 1, 5, 9
SUPPORTED_MATRICES = (0, BT709_MATRIX, UNSPECIFIED, 4, BT601_MATRIX, 6, 7, BT2020_MATRIX, 10)
"""Matrices of ITU-T H.273 that swscale converts from; the others are YCgCo, ICtCp and the like."""


@dataclass(frozen=True)
class VideoInfo:
    """Size, length and frame rate of a video, 0 if unknown.

    ``colours`` describes how its colours are converted or assumed, "" if they are used as tagged.
    """

    width: int
    height: int
    num_frames: int
    fps: float
    colours: str = ""


def list_videos(folder: Path) -> list[Path]:
    """Return the videos directly in a folder, by name, without hidden files.

    Raises DyngsError if two differ only in the suffix.
    """
    with wrap_read_errors(folder, "choose another folder or change its permissions"):
        videos = list_files(folder, VIDEO_SUFFIXES)
    names: dict[str, Path] = {}
    for path in videos:
        if names.setdefault(path.stem, path) != path:
            raise DyngsError(
                f"{folder}: {names[path.stem].name} and {path.name} have the same camera name; "
                "remove one of them"
            )
    return videos


def read_frames(path: Path) -> Iterator[np.ndarray]:
    """Yield the frames of a video in order, (H, W, 3) uint8, rotated by the rotation tag.

    Raises DyngsError if there is no video, or at damaged data.
    """
    for _, frame, tags in _decoded(path, "AUTO"):
        yield _rotated_rgb(path, frame, tags)


def read_numbered_frames(path: Path, numbers: Collection[int]) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the frames with these ``numbers`` (from 0) in ascending order, as ``read_frames``
    does.

    Frames in between are decoded, as frames depend on each other, but not converted. One image is
    in memory at a time.
    """
    requested = set(numbers)
    last = max(numbers, default=-1)
    index = -1
    for index, frame, tags in _decoded(path) if requested else ():
        if index in requested:
            if frame.is_corrupt:
                raise _broken(path, index, "its data is damaged")
            yield index, _rotated_rgb(path, frame, tags)
        if index == last:
            return
    if index < last:
        raise _broken(path, index + 1, "the video ends there")


def probe_video(path: Path) -> VideoInfo:
    """Read size, length and frame rate of a video: decodes the first frame and counts packets."""
    decoded = next(_decoded(path), None)
    if decoded is None:
        raise _broken(path, 0, "it contains no frame")
    _, first, tags = decoded
    height, width = _rotated_rgb(path, first, tags).shape[:2]
    with _reading(path), open_video_container(path) as container:
        stream = container.streams.video[0]
        fps = float(stream.average_rate or 0)
        hidden = [packet.is_discard for packet in _packets(container)]
        # A truncated file still states its full length in the header.
        count = max(stream.frames, len(hidden)) - sum(hidden)
    if count > MAX_FRAMES:
        raise DyngsError(
            f"{path}: the video has {count:,} frames, more than the limit of {MAX_FRAMES:,}; "
            "split it"
        )
    note = tags.conversion
    is_untagged = {tags.primaries, tags.transfer, tags.matrix} == {UNSPECIFIED}
    if is_untagged and _matrix_of(first, tags) == BT709_MATRIX:
        note = "HD without colour tags, assumed to be BT.709"
    return VideoInfo(width, height, count, fps if math.isfinite(fps) else 0.0, note)


def colour_messages(videos: Iterable[VideoInfo]) -> list[str]:
    """Return a message for each kind of colour conversion among the videos of a capture."""
    counts = Counter(video.colours for video in videos if video.colours)
    return [f"{format_count(count, 'video')}: {note}" for note, count in counts.items()]


def frame_seconds(path: Path, num_frames: int) -> list[float]:
    """Return the presentation time of each of the first ``num_frames`` frames, in seconds from 0.

    Uses the time stamps, as phones have variable frame rates; the mean rate (30 if unknown) if
    they are missing or too few.
    """
    stamps: list[float] = []
    with _reading(path), open_video_container(path) as container:
        fps = float(container.streams.video[0].average_rate or 0) or 30.0
        for packet in _packets(container):
            if not packet.is_discard and packet.pts is not None and packet.time_base:
                stamps.append(float(packet.pts * packet.time_base))
    shown = sorted(stamps)[:num_frames]
    if len(shown) < num_frames or len(set(shown)) < num_frames:
        return [number / fps for number in range(num_frames)]
    return [stamp - shown[0] for stamp in shown]


def _packets(container: InputContainer) -> Iterator[av.Packet]:
    """Yield the packets of frames up to a truncation; packets discarded by an edit list are not
    shown."""
    from av.error import FFmpegError

    with suppress(FFmpegError):
        for packet in container.demux(container.streams.video[0]):
            if packet.size > 0:
                yield packet


def _decoded(
    path: Path, threads: Literal["AUTO", "SLICE"] = "SLICE"
) -> Iterator[tuple[int, av.VideoFrame, ColourTags]]:
    """Yield number, frame and colour tags, in order; damage raises an error that names the frame.

    "AUTO" decodes several frames at once, which is faster, but loses frames before damaged data.
    """
    from av.error import FFmpegError

    if not path.is_file():
        raise DyngsError(f"no such video file: {path}")
    index = 0
    with _reading(path):
        try:
            with open_video_container(path) as container:
                stream = container.streams.video[0]
                stream.thread_type = threads
                # Decoders of HEVC and ProRes overwrite the tags of the container, even with
                # "unspecified".
                container_tags = _tags_of(stream.codec_context)
                for frame in container.decode(stream):
                    if (frame.width, frame.height) != (stream.width, stream.height):
                        check_size(path, frame.width, frame.height)
                    yield index, frame, _tags_of(stream.codec_context).or_else(container_tags)
                    index += 1
        except FFmpegError as error:
            if index == 0:
                raise DyngsError(
                    f"cannot read the video {path}: {error.strerror or describe_error(error)}"
                ) from error
            raise _broken(path, index, error.strerror or describe_error(error)) from error


@contextmanager
def open_video_container(path: Path) -> Iterator[InputContainer]:
    """Open a video with PyAV; playlists, which refer to other files, are refused.

    Raises:
        DyngsError: no video in it, or one that is too large.
        FFmpegError: damaged data.
    """
    import av

    options = {"protocol_whitelist": "file", "format_whitelist": _CONTAINERS}
    # Titles may be in any encoding.
    with av.open(f"file:{path}", options=options, metadata_errors="replace") as container:
        if not container.streams.video:
            raise DyngsError(f"{path} has no video stream")
        stream = container.streams.video[0]
        check_size(path, stream.width, stream.height)
        yield container


def _reading(path: Path) -> AbstractContextManager[None]:
    return wrap_read_errors(path, "it must be a video; copy or convert it again")


def _broken(path: Path, index: int, why: str) -> DyngsError:
    return DyngsError(
        f"cannot decode the video {path} at frame {index} ({why}); copy it again, or exclude "
        "that part with data.frames"
    )


def orientation_of(frame: av.VideoFrame) -> int:
    """Return the EXIF orientation (1 to 8) of a frame from its display matrix.

    The matrix maps (x, y) to (a x + c y, b x + d y); it is rounded to quarter turns.
    """
    found: list[Any] = list(frame.side_data)
    matrix = next((bytes(x) for x in found if x.type.name == "DISPLAYMATRIX"), b"")
    if len(matrix) < 36:
        return 1
    a, b, _, c, d = struct.unpack("9i", matrix[:36])[:5]
    if abs(a) + abs(d) >= abs(b) + abs(c):
        return {(False, False): 1, (True, False): 2, (True, True): 3, (False, True): 4}[
            a < 0, d < 0
        ]
    return {(False, False): 5, (False, True): 6, (True, True): 7, (True, False): 8}[b < 0, c < 0]


def _tags_of(context: VideoCodecContext) -> ColourTags:
    is_full_range = context.color_range == _FULL_RANGE
    return ColourTags(context.color_primaries, context.color_trc, context.colorspace, is_full_range)


def _matrix_of(frame: av.VideoFrame, tags: ColourTags) -> int:
    """Return the YCbCr matrix of a frame; if untagged, by the primaries, else by the frame
    size."""
    if tags.matrix != UNSPECIFIED or frame.format.is_rgb:
        return tags.matrix
    if tags.gamut == BT2020:
        return BT2020_MATRIX
    is_hd = frame.width >= 1280 or frame.height > 576
    return BT709_MATRIX if is_hd else BT601_MATRIX


def _rotated_rgb(path: Path, frame: av.VideoFrame, tags: ColourTags) -> np.ndarray:
    matrix = _matrix_of(frame, tags)
    if matrix not in SUPPORTED_MATRICES:  # as that of Dolby Vision without a base layer
        raise DyngsError(
            f"{path}: its colours have the matrix {matrix} of ITU-T H.273, which is not "
            "supported; export the video as SDR, HLG or HDR10"
        )
    # The nearest sample of chroma, as swscale takes it for 8 bits: filters mix colours at edges,
    # which the curves of HDR amplify.
    convert = partial(
        frame.to_ndarray,
        src_colorspace=matrix,
        src_color_range=_FULL_RANGE if tags.is_full_range else None,
        interpolation="POINT",
    )
    with _reading(path):  # a damaged frame may not be convertible
        if not tags.conversion:
            rgb = convert(format="rgb24")
        else:
            # swscale expands limited range to 255 levels of 256 steps each.
            white = 65535 if tags.is_full_range else 255 * 256
            is_deep = frame.format.components[0].bits > 8
            wide = (
                convert(format="rgb48le")
                if is_deep
                else convert(format="rgb24") * np.uint16(white // 255)
            )
            rgb = to_srgb(wide, tags, white)
        return rotate_upright(rgb, orientation_of(frame))


# Cache of frames as image files, found again by the content of the video

MAX_CACHED_BYTES = 4 * 10**9  # of the frames of one capture, times ``DYNGS_LIMITS``
_KEPT_SECONDS = 3 * 86_400  # frames used more recently may belong to a running training
_WHOLE_BYTES = 2**30  # larger videos are compared by their beginning and modification time only
_MARK_NAME = "video.json"


@dataclass(frozen=True)
class VideoFrames:
    """Image files of the frames of the video ``source``, in order; ``decode_frames`` writes
    missing ones."""

    info: VideoInfo
    source: Path
    paths: tuple[Path, ...]


def locate_cached_frames(video: Path) -> VideoFrames:
    """Return the frames of ``video`` and the files they are cached in; nothing is written.

    The files are ``CACHE/frames/NAME.DIGEST/frame_000000.png`` and so on; ``video.json`` next to
    them stores the ``VideoInfo`` and marks the folder as part of the cache.
    """
    with wrap_read_errors(check_inside(video), "check the path and its permissions"):
        status = video.stat()
        digest = _digest(video, status.st_size, status.st_mtime_ns)
    label = re.sub(r"[^A-Za-z0-9-]", "_", video.stem)[:40]
    # Two cameras may have filmed the same: the name keeps their frames apart.
    named = hashlib.sha256(os.fsencode(video.name) + b"\0" + digest + DECODER_VERSION).hexdigest()
    folder = cache_folder("frames") / f"{label}.{named[:32]}"
    info = _stored_info(folder) or probe_video(video)
    numbers = range(info.num_frames)
    return VideoFrames(info, video, tuple(folder / f"frame_{i:06d}.png" for i in numbers))


def decode_frames(root: Path, frames: Mapping[Path, VideoFrame]) -> None:
    """Decode the frames whose image files are missing; every file is written atomically.

    The total size is extrapolated from the frames written so far, to fail early. Least recently
    used frames of other captures are removed to make room. Raises DyngsError for a damaged video,
    or if the limit is exceeded.
    """
    videos = {path.parent: frame.video for path, frame in frames.items()}
    missing: dict[Path, list[int]] = {folder: [] for folder in videos}
    for path, frame in frames.items():
        if not path.is_file():
            missing[path.parent].append(frame.number)
    need = sum(map(len, missing.values()))
    count = written = 0
    for folder, numbers in missing.items():
        mark = folder / _MARK_NAME
        if not _stored_info(folder):
            write_text(mark, json.dumps(asdict(probe_video(videos[folder]))))
        with suppress(OSError):  # a read-only cache
            os.utime(mark)
        for number, rgb in read_numbered_frames(videos[folder], numbers):
            path = folder / f"frame_{number:06d}.png"
            # a third of the time of the usual level, a tenth more bytes
            write_image(path, rgb, png_level=1)
            count += 1
            written += path.stat().st_size
            if count & (count - 1) == 0:  # 1, 2, 4, 8, ...
                more = written * (need - count) // count
                total = sum(map(_num_bytes, videos)) + more
                require_at_most(root, total, MAX_CACHED_BYTES, "bytes of video frames")
                _make_room(videos, total)


def _make_room(kept: Collection[Path], total: int) -> None:
    """Remove the least recently used folders while they and ``total`` bytes exceed the limit."""
    marks = [folder / _MARK_NAME for folder in cache_folder("frames").iterdir()]
    others = [mark for mark in marks if mark.parent not in kept and _stored_info(mark.parent)]
    for mark in sorted(others, key=lambda mark: mark.stat().st_mtime, reverse=True):
        total += _num_bytes(mark.parent)
        is_old = mark.stat().st_mtime < time.time() - _KEPT_SECONDS
        if total > scaled_limit(MAX_CACHED_BYTES) and is_old:
            shutil.rmtree(mark.parent, ignore_errors=True)


@lru_cache(maxsize=4096)
def _digest(video: Path, size: int, changed_ns: int) -> bytes:
    """Return a SHA-256 of size and content; for huge files of size, modification time and
    beginning."""
    digest = hashlib.sha256(str(size).encode())
    if size > _WHOLE_BYTES:
        digest.update(str(changed_ns).encode())
    with video.open("rb") as file:
        while block := file.read(2**20):
            digest.update(block)
            if size > _WHOLE_BYTES:
                break
    return digest.digest()


def _stored_info(folder: Path) -> VideoInfo | None:
    """Return the stored info of a cached video, None if there is no valid one."""
    try:
        return VideoInfo(**json.loads(read_limited(folder / _MARK_NAME)))
    except (DyngsError, OSError, ValueError, TypeError):
        return None


def _num_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob("*.png"))
