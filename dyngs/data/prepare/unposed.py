"""Photos and videos without poses, given as a capture: their poses are estimated first, and cached."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable
from pathlib import Path

from dyngs.config import DataConfig
from dyngs.conventions import ReportProgress, report_nothing
from dyngs.data.pictures.video import VIDEO_SUFFIXES
from dyngs.data.prepare.sfm import SfmOptions, estimate_poses, photos_below
from dyngs.data.read import FORMATS
from dyngs.errors import DyngsError, reading
from dyngs.files.cache import cache_folder

FEWEST_PHOTOS = 3
_SAMPLE_BYTES = 2**20


def with_poses(
    data: DataConfig,
    *,
    needs_times: bool = False,
    say: Callable[[str], None] = print,
    report: ReportProgress = report_nothing,
) -> DataConfig:
    """Return the options with a capture that has poses as their folder: the given one, unless it has none.

    Photos and videos without poses go through structure from motion once; the same ones are found in the user's cache
    from then on. Of a folder that holds ``images``, those are the photos: masks and maps beside them are not.

    Args:
        data: its ``root`` is a capture of any format, a folder of photos, or a video.
        needs_times: something is to move, so photos must have an order.
        say: is told in a line what will be done, and what came out.
        report: is told how far structure from motion has come.

    Raises:
        DyngsError: photos without times where they are needed, several videos, or poses that cannot be found.
    """
    if not _is_unposed(data):
        return data
    source = data.root / "images" if (data.root / "images").is_dir() else data.root
    if source.is_dir() and needs_times and data.times == "files":
        raise DyngsError(
            f"{source}: photos have no times, so nothing can move; give data.times=order if their names are in the "
            "order of time, a video, or train configs/static.yaml"
        )
    folder = cache_folder("poses") / f"{re.sub(r'[^A-Za-z0-9-]', '_', source.stem)[:40]}.{_digest(source)}"
    if folder.is_dir():
        say(f"{source} has no poses; those of before are in {folder}")
    else:
        say(f"{source} has no poses; they are estimated first, as by `dyngs data sfm`, into {folder}")
        options = SfmOptions(follow_links=data.follow_links, max_megapixels=data.max_megapixels)
        say(estimate_poses(source, folder, options, report).summary())
    return data.model_copy(update={"root": folder})


def _is_unposed(data: DataConfig) -> bool:
    """Whether ``data.root`` is a video, or a folder of photos that no reader of captures knows.

    Raises:
        DyngsError: a folder of several videos and nothing else: the poses of standing cameras are not estimated.
    """
    root = data.root
    if root.is_file():
        return root.suffix.lower() in VIDEO_SUFFIXES
    if data.format != "auto" or not root.is_dir():
        return False
    with reading(root, "choose another folder or change its permissions"):
        if any(format.recognise(root) for format in FORMATS):
            return False
        if len(photos_below(root)) >= FEWEST_PHOTOS:
            return True
        videos = [path.name for path in sorted(root.iterdir()) if path.suffix.lower() in VIDEO_SUFFIXES]
    if videos:
        more = f" and {len(videos) - 1} more" if len(videos) > 1 else ""
        raise DyngsError(
            f"{root}: holds videos ({videos[0]}{more}) without poses; give one video as data.root, or the poses of "
            "cameras that stand still in a cameras.json (docs/formats.md)"
        )
    return False


def _digest(source: Path) -> str:
    """Return 16 hexadecimal digits of a video's or of photos' names, sizes, beginnings and times of change."""
    digest = hashlib.sha256()
    for path in [source] if source.is_file() else photos_below(source):
        with reading(path):
            status = path.stat()
            digest.update(os.fsencode(path.relative_to(source.parent)))
            digest.update(f"{status.st_size} {status.st_mtime_ns}".encode())
            if source.is_file():
                with path.open("rb") as file:
                    digest.update(file.read(_SAMPLE_BYTES))
    return digest.hexdigest()[:16]
