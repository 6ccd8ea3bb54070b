"""Checks of output paths, and advice on paths that were given in the wrong place."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cached_property
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
"""In a capture made of photos or videos: where these lie."""
_RUN_MARK = "config.yaml"
"""In a run folder, which is no part of the capture that it lies in."""
_OF_RUNS = ("checkpoints", "scene.dyngs")
_MAX_SOURCES_BYTES = 2**20
_Identity = tuple[int | str, int | str]


class Inputs:
    """Files and folders that are read; a folder stands for all that lies in it.

    Args:
        paths: of what is read; what is None or does not exist counts for nothing.
        elsewhere: yields more files where they are costly to find; only called for outputs that
            exist.
    """

    def __init__(
        self, paths: Iterable[Path | None], elsewhere: Callable[[], Iterable[Path]] = tuple
    ) -> None:
        self.paths = tuple(path for path in paths if path is not None)
        self.elsewhere = elsewhere

    def require_output(self, out: Path) -> None:
        """Check that ``out`` may be written: it does not exist, or is none of the inputs.

        Raises DyngsError: ``out`` is an input, or a link to one, by whatever spelling; it exists in
        a folder that is read; it is a folder that holds a link to an input; a link leads it out of
        its run folder; or it is a device, a pipe or the like. A run folder in a capture, an empty
        folder, and a folder around a capture may be written to.
        """
        require_within_run(out)
        require_replaceable(out)
        if not os.path.lexists(out):
            return
        for folder in self._folders:
            _require_outside(out, folder)
        own = _identity(out)
        if own is not None and own in self._files:
            source = self._files[own]
            as_what = "" if os.path.abspath(out) == os.path.abspath(source) else f", as {source}"
            raise DyngsError(f"{out}: is the file that is read{as_what}; give another output")
        if out.is_dir():
            self._require_no_links(out)

    def _require_no_links(self, out: Path) -> None:
        for name in sorted(os.listdir(out)):
            path = out / name
            source = self._files.get(_identity(path) or ("", ""))
            if source is not None and os.path.abspath(source) != os.path.abspath(path):
                raise DyngsError(
                    f"{out}: holds {name}, a link to {source}, which is read; give another folder"
                )

    @cached_property
    def _folders(self) -> tuple[Path, ...]:
        return tuple(path for path in (*self.paths, *_sources(self.paths)) if path.is_dir())

    @cached_property
    def _files(self) -> dict[_Identity, Path]:
        """All files that are read, also below folders and through links, by what tells them from
        others."""
        single = (
            path
            for path in (*self.paths, *_sources(self.paths), *self.elsewhere())
            if not path.is_dir()
        )
        paths = (
            *single,
            *(path for folder in self._folders for path in _files_below(folder, set())),
        )
        return {identity: path for path in paths if (identity := _identity(path)) is not None}


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


def note_sources(capture: Path, *sources: Path) -> None:
    """Write into a made capture where its photos or videos lie, next to those noted before; no
    output replaces them."""
    known = _read_sources(capture)
    names = list(dict.fromkeys([*known, *(os.path.abspath(source) for source in sources)]))
    if names != known:
        write_text(capture / SOURCES_NAME, json.dumps({"sources": names}, indent=1) + "\n")


def _require_outside(out: Path, folder: Path) -> None:
    """Check that an existing ``out`` is not ``folder`` and does not lie in it; it may hold it."""
    own = _identity(out)
    root = _identity(folder)
    if own == root:
        raise DyngsError(f"{out}: is the folder that is read; give another output")
    if out.is_dir() and not any(out.iterdir()):
        return
    for way in _ways(out):
        above = [_identity(path) for path in (way, *way.parents)]
        below = (way, *way.parents)[: above.index(root)] if root in above else ()
        if below and not any((path / _RUN_MARK).is_file() for path in below):
            raise DyngsError(
                f"{out}: exists and lies in {folder}, which is read; give another output, or remove it first if it is "
                "no part of that"
            )


def _sources(paths: Iterable[Path]) -> list[Path]:
    return [Path(name) for path in paths for name in _read_sources(path)]


def _read_sources(capture: Path) -> list[str]:
    try:
        names = json.loads(read_limited(capture / SOURCES_NAME, _MAX_SOURCES_BYTES))["sources"]
        return [name for name in names if isinstance(name, str) and "\0" not in name]
    except (DyngsError, OSError, ValueError, KeyError, TypeError, RecursionError):
        # costs no more than this protection
        return []


def _files_below(folder: Path, seen: set[_Identity]) -> Iterator[Path]:
    """Yield all files below a folder, also through links to folders, each folder once; those of
    runs are left out."""
    identity = _identity(folder)
    if identity is None or identity in seen:
        return
    seen.add(identity)
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except OSError:  # what cannot be listed is not read either
        return
    for entry in entries:
        if entry.is_dir():
            if not (Path(entry.path) / _RUN_MARK).is_file():
                yield from _files_below(Path(entry.path), seen)
        else:
            yield Path(entry.path)


def _ways(path: Path) -> tuple[Path, Path]:
    """Return where a path lies, and where a link of that name leads to; with no links above
    either."""
    real = Path(os.path.realpath(path))
    return (
        real if path.name in ("", "..") else Path(os.path.realpath(path.parent), path.name)
    ), real


def _identity(path: Path) -> _Identity | None:
    """Return what two names of one file have in common; None where there is no file."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return None
    if status.st_ino:
        return status.st_dev, status.st_ino
    # a file system without such numbers; they mostly ignore case
    return "", os.path.realpath(path).casefold()
