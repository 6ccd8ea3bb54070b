"""Cache of video frames as image files: decoded once, within a disk limit, found again by the
video's content.

The frames of a video lie in ``CACHE/frames/NAME.DIGEST/frame_000000.png`` and so on; ``video.json``
next to them holds the video's size and frame rate and marks the folder as ours. Nothing is ever
written to a capture. Only files named like ours in folders with that mark are removed, never
through a link.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import numpy as np

from dyngs.core.errors import DyngsError, reading
from dyngs.data.capture import VideoFrame
from dyngs.data.images.video import DECODER_VERSION, VideoInfo, probe_video, read_numbered_frames
from dyngs.io.containment import inside
from dyngs.io.fields import read_limited
from dyngs.io.write import CACHE_VARIABLE, atomic_file, cache_folder, image_error, write_text

try:
    import fcntl
except ImportError:  # Windows, where an open file cannot be removed
    fcntl = None

WHOLE_BYTES = 2**30  # larger videos are compared by their beginning and modification time only
_MARK_NAME = "video.json"
_MARK = "frames that dyngs decoded from a video; the folder may be removed"
_BLOCK_BYTES = 2**20
_OUR_FILES = re.compile(r"\.?(frame_\d{6,}|video)(\.\d+-[0-9a-f]{6}\.dyngs)?\.(png|json)")
_MAX_LOCKED = 256
_locked: dict[Path, BinaryIO] = {}
"""Marks that this process keeps open and locked, so that no other process removes frames that it
reads."""


@dataclass(frozen=True)
class VideoFrames:
    """Image files of the frames of the video ``source``, in order; ``decode_frames`` writes those
    that are missing."""

    info: VideoInfo
    source: Path
    paths: tuple[Path, ...]


def planned_frames(video: Path) -> VideoFrames:
    """Return the frames of ``video`` and where they are cached; nothing is written."""
    inside(video)
    try:
        status = video.stat()
        digest = _digest(video, status.st_size, status.st_mtime_ns)
    except OSError as error:
        raise DyngsError(f"{video}: cannot be opened ({error.strerror})") from None
    label = re.sub(r"[^A-Za-z0-9-]", "_", video.stem)[:40]
    # Two cameras may have filmed the same: the name keeps their frames apart.
    named = hashlib.sha256(os.fsencode(video.name) + b"\0" + digest + DECODER_VERSION).hexdigest()[
        :32
    ]
    folder = cache_folder("frames") / f"{label}.{named}"
    info = _stored_info(folder) or probe_video(video)
    return VideoFrames(
        info, video, tuple(folder / f"frame_{number:06d}.png" for number in range(info.num_frames))
    )


def decode_frames(root: Path, frames: Mapping[Path, VideoFrame], limit_mb: float) -> None:
    """Decode the frames whose image is missing; every file is written atomically.

    The total size is estimated from the frames written so far, from the first on, so that too much
    is refused early. The least recently used frames of other captures are removed to make room,
    unless a running process uses them. All may take ``limit_mb`` 1e6 bytes on disk. Raises
    DyngsError: a damaged video (names it and the frame), more than the limit or than the disk has
    (says how much).
    """
    videos = {path.parent: frame.video for path, frame in frames.items()}
    for folder in videos:
        _lock(folder)
    missing: dict[Path, list[int]] = {}
    for path in sorted(frames):
        if not path.is_file():
            missing.setdefault(path.parent, []).append(frames[path].number)
    if not missing:
        return
    need = sum(map(len, missing.values()))
    count = 0
    written = 0
    for folder, numbers in missing.items():
        _make(folder, videos[folder])
        for number, rgb in read_numbered_frames(videos[folder], numbers):
            path = folder / f"frame_{number:06d}.png"
            _write_png(path, rgb)
            count += 1
            written += path.stat().st_size
            if count & (count - 1) == 0:  # 1, 2, 4, 8, ...
                _make_room(root, videos.keys(), written * (need - count) / count, limit_mb)


def _make(folder: Path, video: Path) -> None:
    """Create the folder with its mark before anything else is in it."""
    if not _stored_info(folder):
        text = json.dumps({"what": _MARK, **asdict(probe_video(video))})
        try:
            if folder.is_symlink():
                raise DyngsError("it is a link")
            write_text(folder / _MARK_NAME, text)
        except DyngsError as error:
            raise DyngsError(
                f"{folder}: the frames of a video cannot be kept there ({error}); set {CACHE_VARIABLE} to a folder "
                "that can be written"
            ) from error
    _lock(folder)


def _write_png(path: Path, rgb: np.ndarray) -> None:
    """Write (H, W, 3) uint8 with little compression: a third of the time of the usual level, a
    tenth more bytes."""
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(rgb.shape[1], rgb.shape[0], 3, oiio.UINT8)
    spec.attribute("png:compressionLevel", 1)
    with atomic_file(path) as temporary, reading(path, "the disk may be full"):
        output = oiio.ImageOutput.create(str(temporary))
        written = (
            output is not None and output.open(str(temporary), spec) and output.write_image(rgb)
        )
        problem = image_error(oiio if output is None else output)
        if output is None or not (output.close() and written):
            raise DyngsError(f"cannot write {path}: {problem or 'the disk may be full'}")


@lru_cache(maxsize=4096)
def _digest(video: Path, size: int, changed_ns: int) -> bytes:
    """SHA-256 of size and bytes; for huge files of size, modification time and the beginning."""
    digest = hashlib.sha256(str(size).encode())
    if size > WHOLE_BYTES:
        digest.update(str(changed_ns).encode())
    with video.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            digest.update(block)
            if size > WHOLE_BYTES:
                break
    return digest.digest()


def _stored_info(folder: Path) -> VideoInfo | None:
    """Return what the mark of ``folder`` says about the video, None without a mark of ours."""
    mark = folder / _MARK_NAME
    if folder.is_symlink() or mark.is_symlink():
        return None
    try:
        fields = json.loads(read_limited(mark))
        width, height, count = (int(fields[key]) for key in ("width", "height", "num_frames"))
        info = VideoInfo(width, height, count, float(fields["fps"]), str(fields.get("colours", "")))
        return info if fields["what"] == _MARK else None
    except (DyngsError, OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return None


def _lock(folder: Path) -> None:
    """Protect the folder, if it exists, from removal by other processes while this one lives, and
    note its use."""
    mark = folder / _MARK_NAME
    if _stored_info(folder) is None:
        return
    try:
        os.utime(mark)
        if folder in _locked and os.path.samestat(os.fstat(_locked[folder].fileno()), mark.stat()):
            return
        if len(_locked) < _MAX_LOCKED:
            _locked[folder] = mark.open("rb")
            if fcntl is not None:
                fcntl.flock(_locked[folder], fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        # a read-only cache, or another process is removing it: what is missing then is decoded
        # again
        pass


def _make_room(root: Path, kept: Collection[Path], more: float, limit_mb: float) -> None:
    """Free space for ``more`` bytes in the folders ``kept``: the least recently used frames of
    other captures are removed.

    Raises DyngsError: it is more than the limit, or than other processes or the disk leave.
    """
    cache = cache_folder("frames")
    limit = limit_mb * 1e6
    there = sum(map(_num_bytes, kept))
    total = there + more
    if total > limit:
        raise DyngsError(
            f"{root}: the frames of its videos need about {total / 1e6:.4g} MB on disk, of which {there / 1e6:.4g} MB "
            f"are there, but data.frame_cache_mb is {limit_mb:g}; raise it, or choose fewer with "
            "data.frames=start:stop:step"
        )
    others = [folder for folder in _our_folders() if folder not in kept]
    elsewhere = sum(map(_num_bytes, others))
    for folder in sorted(others, key=lambda folder: (folder / _MARK_NAME).stat().st_mtime_ns):
        if elsewhere + total > limit and folder not in _locked:
            elsewhere -= _remove(folder)
    if elsewhere + total > limit:
        raise DyngsError(
            f"{cache}: the frames of other videos, which are in use, take {elsewhere / 1e6:.4g} MB, and those of "
            f"{root} need about {total / 1e6:.4g} MB, but data.frame_cache_mb is {limit_mb:g}; raise it, or wait until "
            "the others are done"
        )
    free = shutil.disk_usage(cache).free
    if more > free:
        raise DyngsError(
            f"{cache}: the frames of the videos need about {more / 1e6:.4g} MB more, but the disk has only "
            f"{free / 1e6:.4g} MB left; free some, set {CACHE_VARIABLE} to a folder on another disk, or choose fewer "
            "with data.frames=start:stop:step"
        )


def _our_folders() -> list[Path]:
    cache = cache_folder("frames")
    return [folder for folder in cache.iterdir() if _stored_info(folder)] if cache.is_dir() else []


def _remove(folder: Path) -> int:
    """Remove our files from a folder, and the folder if nothing else is in it; return the bytes
    freed."""
    freed = 0
    try:
        with (folder / _MARK_NAME).open("rb") as mark:
            if fcntl is not None:
                fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
            for path in sorted(_own_files(folder), key=lambda path: path.name == _MARK_NAME):
                size = path.stat().st_size
                path.unlink()
                freed += size
        folder.rmdir()
    except OSError:
        pass  # another process reads these frames, or somebody else's files are there, too
    return freed


def _own_files(folder: Path) -> list[Path]:
    with os.scandir(folder) as entries:
        ours = [
            x for x in entries if x.is_file(follow_symlinks=False) and _OUR_FILES.fullmatch(x.name)
        ]
    return [Path(found.path) for found in ours]


def _num_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in _own_files(folder)) if _stored_info(folder) else 0
