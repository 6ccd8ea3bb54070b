"""Checks of output paths, and advice on paths that were given in the wrong place."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

from dyngs.core.errors import DyngsError, as_word
from dyngs.io.fields import read_limited
from dyngs.io.write import remove_quietly, require_replaceable, temporary_folder_beside, write_text

PHOTO_SUFFIXES = frozenset(
    {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".gif", ".heic", ".heif", ".hif"}
)
VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")
_MOST_ENTRIES = 2000
_CAPTURE = (
    "transforms.json",
    "transforms_train.json",
    "cameras.json",
    "poses_bounds.npy",
    "sparse",
    "dataset.json",
)


def command_for(path: Path, *, captures: bool = True) -> str | None:
    """Return what the path is and the command that takes it, in a few words; None for anything
    else.

    Only names are looked at, those directly in a folder and in ``images`` below it.
    """
    where = as_word(path)
    static, dynamic = (
        f"`dyngs train {preset} data.root={where}`" for preset in ("static", "dynamic")
    )
    try:
        if path.is_file():
            if path.suffix.lower() not in VIDEO_SUFFIXES:
                return None
            return f"it is a video, make a scene of it with {static}, or {dynamic} if things move"
        if not path.is_dir():
            return None
        if (path / "config.yaml").is_file():
            return f"it is a run, for `dyngs eval {where}`, `dyngs render {where}` or `dyngs train --resume {where}`"
        if captures and any((path / name).exists() for name in _CAPTURE):
            return f"it is a capture, make a scene of it with {static}, or {dynamic} if things move"
        suffixes = [
            _suffix(entry) for folder in (path, path / "images") for entry in _entries(folder)
        ]
    except OSError:
        return None
    photos = sum(x in PHOTO_SUFFIXES for x in suffixes)
    videos = sum(x in VIDEO_SUFFIXES for x in suffixes)
    if photos >= 3:
        return f"it holds photos, make a scene of them with {static}"
    if videos > 1:
        return f"it holds {videos} videos, make a scene of them with {dynamic}"
    return "it holds one video; give that" if videos else None


def _entries(folder: Path) -> list[Path]:
    return list(islice(folder.iterdir(), _MOST_ENTRIES)) if folder.is_dir() else []


def _suffix(path: Path) -> str:
    return "" if path.name.startswith(".") else path.suffix.lower()


SOURCES_NAME = "sources.json"
"""In a capture made of photos or a video: where these lie."""
_RUN_MARK = "config.yaml"
"""In a run folder, which is no part of the capture that it lies in."""
_OF_RUNS = ("checkpoints", "scene.dyngs")


class Inputs:
    """Files and folders that are read; a folder stands for all that lies in it.

    A link in a folder stands for the file or folder that it leads to, a capture that dyngs made
    also for its photos or video. What is None counts for
    nothing.
    """

    def __init__(self, paths: Iterable[Path | None]) -> None:
        self.paths = {path.resolve() for path in paths if path is not None}
        for folder in [path for path in self.paths if path.is_dir()]:
            self.paths |= {path.resolve() for path in folder.iterdir() if path.is_symlink()}
            self.paths |= _sources(folder)

    def require_output(self, out: Path) -> None:
        """Check that ``out`` may be written: it does not exist, or is none of the inputs.

        Raises DyngsError: ``out`` is an input, or leads to one; it exists in a folder that is read;
        a link leads it out of its run folder; or it is a device, a pipe or the like. A run folder
        in a capture, an empty folder, and a folder around a capture may be written to. A link that
        is a file is replaced itself.
        """
        require_within_run(out)
        require_replaceable(out)
        if not os.path.lexists(out) or (out.is_dir() and not any(out.iterdir())):
            return
        for place in (out.resolve(), out.parent.resolve() / out.name):
            for folder in (place, *place.parents):
                if folder in self.paths:
                    where = "" if folder == place else f" in {folder}"
                    raise DyngsError(f"{out}: exists{where}, which is read; give another output")
                if (folder / _RUN_MARK).is_file():
                    break


def require_within_run(out: Path) -> None:
    """Check that no link leads an output in a run folder, perhaps a stranger's, out of it."""
    for run in out.absolute().parents:
        if (run / _RUN_MARK).is_file() and any((run / name).exists() for name in _OF_RUNS):
            place = out if out.is_dir() else out.parent
            if not place.resolve().is_relative_to(run.resolve()):
                raise DyngsError(
                    f"{out}: a link leads to {place.resolve()}, out of the run; give another output"
                )
            return


def require_new_folder(out: Path) -> None:
    """Check that ``out`` does not exist or is an empty folder. Raises DyngsError if it holds
    something or is a file."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DyngsError(f"{out} exists already; name a new folder")


@contextmanager
def new_folder(out: Path, require: Callable[[Path], None] = require_new_folder) -> Iterator[Path]:
    """Yield a hidden folder next to ``out`` that gets its name when the block ends well, and is
    removed otherwise.

    Raises DyngsError: by ``require``, before and after; ``out`` cannot be written.
    """
    require(out)
    started = temporary_folder_beside(out)
    try:
        yield started
        try:
            if out.is_dir():
                out.rmdir()
            started.rename(out)
        except OSError as error:
            require(out)
            raise DyngsError(f"cannot write {out}: {error.strerror or error}") from error
    finally:
        remove_quietly(started)


def note_source(capture: Path, source: Path) -> None:
    """Write into a made capture where its photos or video lie; no output replaces them."""
    names = {"sources": [os.path.abspath(source)]}
    write_text(capture / SOURCES_NAME, json.dumps(names, indent=1) + "\n")


def _sources(capture: Path) -> set[Path]:
    try:
        names = json.loads(read_limited(capture / SOURCES_NAME))["sources"]
        return {Path(name) for name in names}
    except Exception:  # a missing or damaged file costs no more than this protection
        return set()
