"""Frames of videos as picture files: decoded once, within a disk limit, found again while the video is unchanged.

The frames of ``ROOT/cam00.mp4`` lie in ``ROOT/.dyngs_frames/cam00.mp4.DIGEST/frame_000000.png`` and so on, the digest
being that of the video's size and time of change; beside them ``video.json`` holds what the video says about itself.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from dyngs.data.video import VideoInfo, probe_video, read_numbered_frames
from dyngs.data.write import whole_file, write_text
from dyngs.errors import DyngsError

FRAMES_FOLDER = ".dyngs_frames"
_INFO_NAME = "video.json"


@dataclass(frozen=True)
class VideoFrames:
    """Where the frames of a video lie or will lie.

    Attributes:
        info: what the video says about itself.
        paths: one picture file per frame, in order; ``decode_frames`` makes those that are missing.
    """

    info: VideoInfo
    paths: tuple[Path, ...]


def planned_frames(root: Path, video: Path) -> VideoFrames:
    """The frames of ``video``, a file directly in ``root``; nothing is written.

    Raises:
        DyngsError: the video cannot be opened.
    """
    try:
        status = video.stat()
    except OSError as error:
        raise DyngsError(f"{video}: cannot be opened ({error.strerror})") from None
    digest = hashlib.sha256(f"{status.st_size} {status.st_mtime_ns}".encode()).hexdigest()[:12]
    folder = f"{video.name}.{digest}"
    writable, beside = _frames_root(root) / folder, root / FRAMES_FOLDER / folder
    info = _stored_info(writable) or _stored_info(beside) or probe_video(video)
    names = [f"frame_{number:06d}.png" for number in range(info.num_frames)]
    # A capture on a read-only disk may come with some of its frames.
    paths = (beside / name if (beside / name).is_file() else writable / name for name in names)
    return VideoFrames(info, tuple(paths))


def is_video_frame(path: Path) -> bool:
    """Whether ``path`` is a frame that ``planned_frames`` named."""
    return path.parent.parent.name == FRAMES_FOLDER


def decode_frames(root: Path, paths: Iterable[Path], limit_mb: float) -> None:
    """Decode those of ``paths`` that ``planned_frames`` named and that are missing; each file appears whole.

    The need is estimated from the frames written so far, from the first one on, so that too much is refused early.

    Args:
        root: the capture.
        paths: pictures of its views; those that are not frames of a video are left alone.
        limit_mb: all frames of this capture together may take so many 1e6 bytes on disk.

    Raises:
        DyngsError: a damaged video (names it and the frame), more than the limit or than the disk has (says how much).
    """
    missing: dict[Path, list[int]] = {}
    for path in sorted(set(paths)):
        if is_video_frame(path) and not path.is_file():
            missing.setdefault(path.parent, []).append(int(path.stem.rpartition("_")[2]))
    if not missing:
        return
    _remove_outdated(missing)
    used = sum(_num_bytes(frames_root) for frames_root in {folder.parent for folder in missing})
    need, count, written = sum(map(len, missing.values())), 0, 0
    for folder, numbers in missing.items():
        video = root / folder.name.rpartition(".")[0]
        for number, rgb in read_numbered_frames(video, numbers):
            path = folder / f"frame_{number:06d}.png"
            _write_png(path, rgb)
            count, written = count + 1, written + path.stat().st_size
            _check_need(root, folder, used, (written, written * need / count), limit_mb)
        write_text(folder / _INFO_NAME, json.dumps(asdict(probe_video(video))))


def _write_png(path: Path, rgb: np.ndarray) -> None:
    """Write (H, W, 3) uint8 with little compression: a third of the time of the usual level, a tenth more bytes."""
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(rgb.shape[1], rgb.shape[0], 3, oiio.UINT8)
    spec.attribute("png:compressionLevel", 1)
    with whole_file(path) as temporary:
        output = oiio.ImageOutput.create(str(temporary))
        written = output is not None and output.open(str(temporary), spec) and output.write_image(rgb)
        problem = oiio.geterror() if output is None else output.geterror()
        if output is None or not (output.close() and written):
            raise DyngsError(f"cannot write {path}: {problem or 'the disk may be full'}")


def _frames_root(root: Path) -> Path:
    """The folder of frames beside the videos, or one in the user's cache if nothing can be written there."""
    beside = root / FRAMES_FOLDER
    if os.access(beside if beside.is_dir() else root, os.W_OK):
        return beside
    home = os.environ.get("XDG_CACHE_HOME", "")
    cache = Path(home) if os.path.isabs(home) else Path.home() / ".cache"
    digest = hashlib.sha256(os.fsencode(root.resolve())).hexdigest()[:12]
    return cache / "dyngs" / f"{root.resolve().name}.{digest}" / FRAMES_FOLDER


def _stored_info(folder: Path) -> VideoInfo | None:
    try:
        fields = json.loads((folder / _INFO_NAME).read_text(encoding="utf-8"))
        width, height, count = (int(fields[key]) for key in ("width", "height", "num_frames"))
        return VideoInfo(width, height, count, float(fields["fps"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _remove_outdated(folders: Iterable[Path]) -> None:
    """Remove the frames of former versions of the videos of ``folders``."""
    for folder in folders:
        video = folder.name.rpartition(".")[0]
        siblings = folder.parent.iterdir() if folder.parent.is_dir() else ()
        for other in siblings:
            if other != folder and other.name.rpartition(".")[0] == video:
                shutil.rmtree(other, ignore_errors=True)


def _num_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob("*/frame_*.png"))


def _check_need(root: Path, folder: Path, used: int, written: tuple[int, float], limit_mb: float) -> None:
    """Refuse to go on if ``written`` (bytes now, and in the end) is too much beside what was ``used`` before."""
    now, end = written
    if used + end > limit_mb * 1e6:
        others = f", of which {folder.parent} holds {used / 1e6:.4g} MB already" if used else ""
        raise DyngsError(
            f"{root}: the frames of its videos need about {(used + end) / 1e6:.4g} MB on disk{others}, but "
            f"data.frame_cache_mb is {limit_mb:g}; raise it, or choose fewer with data.frames=start:stop:step"
        )
    free = shutil.disk_usage(folder).free
    if end - now > free:
        raise DyngsError(
            f"{folder.parent}: the frames of the videos need about {(end - now) / 1e6:.4g} MB more, but the disk has "
            f"only {free / 1e6:.4g} MB left; free some, or choose fewer with data.frames=start:stop:step"
        )
