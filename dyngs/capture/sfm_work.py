"""Structure from motion: options, result, report, and the folder to work in, which the next try finds again."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Literal

from dyngs.errors import DyngsError
from dyngs.files.containment import MAX_MEGAPIXELS
from dyngs.files.write import write_text

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


REPORT_FILE = "sfm_report.json"
_SHOWN = 5


@dataclass(frozen=True)
class SfmOptions:
    """Options of pose estimation.

    Attributes:
        camera_model: COLMAP's name of the lens model to fit.
        single_camera: one camera took all images, so they share its lens; None = yes for a video, and for photos that
            agree in size, camera model and focal length (EXIF); else every photo has a lens of its own.
        matching: which pairs are compared; auto = all pairs up to 60 photos or 24 frames, beyond that neighbours by
            name (some far ones, too) and those that look alike; sequential = the same without what looks alike.
        overlap: neighbours on either side in sequential matching; None = near ones densely, far ones sparsely.
        mapper: COLMAP's mapping; auto = global, and incremental where that finds less.
        max_features: SIFT features per image.
        longest_side: images are shrunk to this, in pixels, for finding features (poses refer to the full size).
        num_frames: images to take from a video, by motion seen and sharpness.
        masks: folder of masks of the photos, named as in captures; white = keep. None without.
        seed: of everything random.
        num_threads: for features and matches, 0 = all cores; mapping has one, so that the result is always the same.
        follow_links: photos may be links that lead out of their folder.
        max_megapixels: larger images and videos are refused.
    """

    camera_model: Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"] = (
        "SIMPLE_RADIAL"
    )
    single_camera: bool | None = None
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    overlap: int | None = None
    mapper: Literal["auto", "global", "incremental"] = "auto"
    max_features: int = 8192
    longest_side: int = 1600
    num_frames: int = 100
    masks: Path | None = None
    seed: int = 0
    num_threads: int = 0
    follow_links: bool = False
    max_megapixels: float = MAX_MEGAPIXELS


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
            "move fill them, or the camera only rotated there"
        )
    if blurred:
        more = "more light or a slower hand" if is_video else "take them again"
        lines.append(f"{len(blurred)} images are much less sharp than the others ({listed(blurred)}): {more}")
    return tuple(lines)


_KEY, _LOCK = "task.txt", "lock"


class ColmapError(DyngsError):
    """COLMAP failed."""


@contextmanager
def quiet_colmap(seed: int) -> Iterator[None]:
    """Keep COLMAP's log out of the terminal, and make it start from a seed; its errors in the block are ours."""
    import pycolmap

    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, pycolmap.logging.Level.FATAL.value
    pycolmap.set_random_seed(seed)
    try:
        yield
    except (RuntimeError, ValueError) as error:
        lines = str(error).strip().splitlines()
        if "database factory" in str(error):  # all that COLMAP says where it cannot open or fill one
            raise ColmapError("COLMAP can make no database there: free some space, or check the disk") from error
        raise ColmapError(f"structure from motion failed: {lines[-1] if lines else error}") from error
    finally:
        pycolmap.logging.minloglevel = level


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
