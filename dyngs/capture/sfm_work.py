"""The folder in which structure from motion works, found again by the next try, and the report on its result."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from dyngs.errors import DyngsError
from dyngs.files.write import write_text

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


REPORT_FILE = "sfm_report.json"
_SHOWN = 5


@dataclass(frozen=True)
class SfmResult:
    """Result of pose estimation.

    Attributes:
        root: the capture folder in COLMAP's layout, to be trained on.
        num_images: images given.
        num_registered: images with a pose.
        unregistered: names of the others.
        num_points: sparse points.
        mean_error_px: mean reprojection error.
        mean_track: images in which a point is seen, on average.
        mapper: "global" or "incremental".
        seconds: of each stage, by name.
        notes: lines about choices, and about what to film or photograph better.
    """

    root: Path
    num_images: int
    num_registered: int
    unregistered: tuple[str, ...]
    num_points: int
    mean_error_px: float
    mean_track: float = 0.0
    mapper: str = ""
    seconds: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def summary(self) -> str:
        """The result as lines of text."""
        lines = [
            f"{self.num_registered} of {self.num_images} images registered, {self.num_points} points, "
            f"mean error {self.mean_error_px:.2f} px: {self.root}"
        ]
        if self.mapper:
            stages = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in self.seconds.items())
            lines.append(f"a point is seen in {self.mean_track:.1f} images on average; {self.mapper} mapping; {stages}")
        if self.unregistered:
            lines.append("no pose for " + listed(self.unregistered))
        return "\n".join((*lines, *self.notes))


def listed(names: Sequence[str]) -> str:
    """Return the first names in a line."""
    return ", ".join(names[:_SHOWN]) + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")


def write_report(folder: Path, result: SfmResult) -> None:
    """Write the result, without its folder, to ``sfm_report.json``."""
    fields = {
        "images": result.num_images,
        "registered": result.num_registered,
        "unregistered": list(result.unregistered),
        "points": result.num_points,
        "mean_reprojection_error_px": round(result.mean_error_px, 4),
        "mean_track_length": round(result.mean_track, 2),
        "mapper": result.mapper,
        "seconds": {name: round(seconds, 1) for name, seconds in result.seconds.items()},
        "notes": list(result.notes),
    }
    write_text(folder / REPORT_FILE, json.dumps(fields, indent=1) + "\n")


def advice(
    unregistered: Sequence[str], lonely: Sequence[str], blurred: Sequence[str], is_video: bool
) -> tuple[str, ...]:
    """Return lines about what to film better.

    Args:
        unregistered: names of images without a pose.
        lonely: those of all images that match fewer than three others.
        blurred: those of all that are much less sharp than the others.
        is_video: they are frames of a video.
    """
    lines = []
    lost, without = set(unregistered), set(lonely)
    apart = [name for name in unregistered if name in without]
    if apart:
        more = "move slower there" if is_video else "take more photos around them"
        lines.append(f"{len(apart)} images without a pose match fewer than three others: {more}")
    if lost and len(apart) < len(lost):
        lines.append(
            f"{len(lost) - len(apart)} images without a pose match others, but fit no common scene: things that "
            "move fill them, or the camera only turned there"
        )
    if blurred:
        more = "more light or a slower hand" if is_video else "take them again"
        lines.append(f"{len(blurred)} images are much less sharp than the others ({listed(blurred)}): {more}")
    return tuple(lines)


_KEY, _LOCK = "task.txt", "lock"


def work_folder_of(out: Path) -> Path:
    """Return the hidden folder beside ``out`` that holds what a stopped run has done."""
    return out.parent / f".{out.name}.sfm"


@contextmanager
def working(out: Path, task: str) -> Iterator[tuple[Path, bool]]:
    """Yield the work folder for ``out``, and whether it holds the beginnings of the same task.

    It is removed when the block ends, and when it raises an error of ours: what failed once fails again. It stays
    where the user or the system stops the program.

    Args:
        out: the folder that is made in the end.
        task: images and options in words; a folder of another task is emptied first.

    Raises:
        DyngsError: another process works there; it cannot be made.
    """
    work = work_folder_of(out)
    if work.is_symlink():
        raise DyngsError(f"{work}: is a link; remove it")
    try:
        work.mkdir(parents=True, exist_ok=True)
        work.chmod(0o700)
        lock = (work / _LOCK).open("ab")
    except OSError as error:
        raise DyngsError(f"cannot write {out}: {error.strerror or error}") from error
    with lock:
        _take(lock, out)
        key = work / _KEY
        goes_on = key.is_file() and key.read_text(encoding="utf-8") == task
        try:
            if not goes_on:
                _empty(work)
                write_text(key, task)
            yield work, goes_on
        except (DyngsError, OSError):
            shutil.rmtree(work, ignore_errors=True)
            raise
        shutil.rmtree(work, ignore_errors=True)


def _take(lock: BinaryIO, out: Path) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise DyngsError(f"another process estimates poses for {out}; wait for it, or name another folder") from None
    except OSError:  # a file system without locks
        return


def _empty(work: Path) -> None:
    for entry in os.scandir(work):
        if entry.name == _LOCK:
            continue
        if entry.is_dir(follow_symlinks=False):
            shutil.rmtree(entry.path)
        else:
            os.unlink(entry.path)
