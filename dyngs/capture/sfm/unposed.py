"""Photos and videos without poses, given as a capture: poses are estimated once and cached."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from dyngs.capture.sfm.colmap import SfmOptions
from dyngs.capture.sfm.estimate import estimate_poses
from dyngs.capture.sfm.photos import digest_files, list_photos
from dyngs.capture.sfm.several_videos import VIDEOS_FILE, poses_of_videos
from dyngs.config import DataConfig
from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError, format_count, log_info, quote_path, wrap_read_errors
from dyngs.data.images.video import VIDEO_SUFFIXES, list_videos
from dyngs.data.read import is_capture
from dyngs.io.outputs import make_once, record_source, suggest_command
from dyngs.io.write import cache_folder

FEWEST_PHOTOS = 3


def ensure_poses(
    data: DataConfig,
    *,
    needs_times: bool = False,
    log: Callable[[str], None] = log_info,
    report: ProgressCallback = ignore_progress,
) -> DataConfig:
    """Return options whose folder is a capture with poses; unchanged if it has poses already.

    Photos and videos without poses go through structure from motion once and are then found in the
    user's cache. In a folder with ``images`` only these are photos. Raises DyngsError for photos
    without times where they are needed, several videos for a static scene, or failed pose
    estimation.

    Args:
        data: its ``root`` is a capture of any format, a folder of photos, or a video.
        needs_times: the scene moves, so photos must have an order.
    """
    if not is_unposed(data):
        return data
    source = data.root / "images" if (data.root / "images").is_dir() else data.root
    videos = list_videos(source) if is_several_videos(source) else []
    if videos and not needs_times:
        raise DyngsError(
            f"{source}: holds {len(videos)} videos; a static scene needs one video of a moving "
            f"camera, several need `dyngs train dynamic {quote_path(source)}`"
        )
    if source.is_dir() and not videos and needs_times and data.times == "files":
        raise DyngsError(
            f"{source}: photos have no times, so a moving scene cannot be trained; set "
            "data.times=order if their names are in temporal order, give a video, or use `dyngs "
            "train static`"
        )
    files = (
        [*videos, *(path for path in [source / VIDEOS_FILE] if path.is_file())] if videos else None
    )
    beside = data.root / "masks"
    masks = beside if source != data.root and beside.is_dir() else None
    digest = digest_files(source, files) + ("" if masks is None else digest_files(masks))
    folder = cache_folder("poses") / f"{re.sub(r'[^A-Za-z0-9-]', '_', source.stem)[:40]}.{digest}"

    def estimate() -> None:
        log(f"{source} has no poses; estimating them (as `dyngs data sfm` does) into {folder}")
        options = SfmOptions(masks=masks, follow_links=data.follow_links)
        if videos:
            log(poses_of_videos(source, folder, options, report))
        else:
            log(estimate_poses(source, folder, options, report).summary())

    make_once(folder, estimate, log, f"{source} has no poses; using the poses cached in {folder}")
    record_source(folder, data.root)
    return data.model_copy(update={"root": folder})


def is_unposed(data: DataConfig) -> bool:
    """Whether ``data.root`` is a video, or a folder of photos or videos that is not a capture.

    Raises DyngsError for a folder with a single video, or with one or two photos.
    """
    root = data.root
    if root.is_file():
        return root.suffix.lower() in VIDEO_SUFFIXES
    if data.format != "auto" or not root.is_dir() or is_capture(root):
        return False
    if _holds_photos(root):
        return True
    videos = list_videos(root)
    if len(videos) == 1:
        raise DyngsError(
            f"{root}: contains one video; give the video itself: data.root={quote_path(videos[0])}"
        )
    photos = (
        [] if videos or suggest_command(root, captures=False) is not None else list_photos(root)
    )
    if photos:
        raise DyngsError(
            f"{root}: holds {format_count(len(photos), 'photo')} but no cameras; a scene needs at "
            f"least {FEWEST_PHOTOS} photos from different positions, ideally 50, or a video"
        )
    return bool(videos)


def is_several_videos(source: Path) -> bool:
    """Whether ``source`` is a folder of two videos or more, and not of photos."""
    return source.is_dir() and not _holds_photos(source) and len(list_videos(source)) > 1


def is_videos(source: Path) -> bool:
    """Whether ``source`` is a video file, or a folder of videos that is no capture and holds no
    photos."""
    if source.is_file():
        return source.suffix.lower() in VIDEO_SUFFIXES
    return (
        source.is_dir()
        and not is_capture(source)
        and not _holds_photos(source)
        and bool(list_videos(source))
    )


def _holds_photos(folder: Path) -> bool:
    with wrap_read_errors(folder, "choose another folder or change its permissions"):
        return len(list_photos(folder)) >= FEWEST_PHOTOS
