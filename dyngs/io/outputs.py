"""Checks of output paths, advice for misplaced paths, atomic folders, and locks.

A lock allows one writer in a folder; the system releases it when its process ends.
"""

from __future__ import annotations

import errno
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dyngs.core.errors import DyngsError, log_warning, quote_path, require_regular_file
from dyngs.io.containment import find_escaping_links
from dyngs.io.fields import read_limited
from dyngs.io.write import remove_quietly, require_replaceable, temporary_folder_beside, write_text

PHOTO_SUFFIXES = frozenset(
    {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".gif", ".heic", ".heif", ".hif"}
)
VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")
_CAPTURE = (
    "transforms.json",
    "transforms_train.json",
    "cameras.json",
    "poses_bounds.npy",
    "sparse",
    "dataset.json",
)


def suggest_command(path: Path, *, captures: bool = True) -> str | None:
    """Return a description of a path with the command that reads it; None: unknown.

    Only file names are checked, those directly in a folder and in ``images`` below it.
    """
    where = quote_path(path)
    train = f"train it with `dyngs train {where}`"
    if path.is_file():
        return f"it is a video, {train}" if path.suffix.lower() in VIDEO_SUFFIXES else None
    if not path.is_dir():
        return None
    if (path / "config.yaml").is_file():
        return f"it is a run, for `dyngs eval {where}`, `dyngs render {where}` or `dyngs train --resume {where}`"
    if captures and any((path / name).exists() for name in _CAPTURE):
        return f"it is a capture, {train}"
    try:
        found = [*path.glob("[!.]*.*"), *path.glob("images/[!.]*.*")]
    except OSError:
        return None
    suffixes = [one.suffix.lower() for one in found]
    videos = sum(x in VIDEO_SUFFIXES for x in suffixes)
    if sum(x in PHOTO_SUFFIXES for x in suffixes) >= 3:
        return f"it is a folder of photos, {train}"
    if videos > 1:
        return f"it is a folder of {videos} videos, {train}"
    return "it is a folder with one video; give the video itself" if videos else None


SOURCES_NAME = "sources.json"
"""In a capture made of photos or a video: where these lie."""
_RUN_MARK = "config.yaml"
"""In a run folder, which is no part of the capture that it lies in."""
_OF_RUNS = ("checkpoints", "scene.dyngs")


class Inputs:
    """Input files and folders; a folder includes its contents, the targets of its links, and the
    photos or video that a capture was made from."""

    def __init__(self, paths: Iterable[Path | None]) -> None:
        self.paths = {path.resolve() for path in paths if path is not None}
        for folder in [path for path in self.paths if path.is_dir()]:
            self.paths |= {path.resolve() for path in folder.iterdir() if path.is_symlink()}
            self.paths |= _sources(folder)

    def require_output(self, out: Path) -> None:
        """Check that ``out`` may be written: it must not exist, or not be part of the inputs.

        Raises DyngsError if ``out`` is an input or links to one, exists in an input folder, links
        out of its run folder, or is not a regular file. A run folder in a capture, an empty
        folder, and a folder around a capture may be written. A link to a file is replaced itself.
        """
        require_within_run(out)
        require_replaceable(out)
        if not os.path.lexists(out) or (out.is_dir() and not any(out.iterdir())):
            return
        for place in (out.resolve(), out.parent.resolve() / out.name):
            for folder in (place, *place.parents):
                if folder in self.paths:
                    where = "" if folder == place else f" in {folder}"
                    raise DyngsError(
                        f"{out}: exists{where}, which is an input; choose another output"
                    )
                if (folder / _RUN_MARK).is_file():
                    break


def require_within_run(out: Path) -> None:
    """Check that no link leads an output out of its run folder, which may come from a stranger."""
    for run in out.absolute().parents:
        if (run / _RUN_MARK).is_file() and any((run / name).exists() for name in _OF_RUNS):
            place = out if out.is_dir() else out.parent
            if not place.resolve().is_relative_to(run.resolve()):
                raise DyngsError(
                    f"{out}: is a link to {place.resolve()}, outside the run folder; choose "
                    "another output"
                )
            return


def require_new_folder(out: Path) -> None:
    """Check that ``out`` does not exist or is an empty folder. Raises DyngsError if it holds
    something or is a file."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DyngsError(f"{out} exists already; choose a new folder")


@contextmanager
def atomic_folder(
    out: Path, require: Callable[[Path], None] = require_new_folder
) -> Iterator[Path]:
    """Yield a hidden folder next to ``out`` that is renamed to ``out`` on success and removed
    otherwise.

    Raises DyngsError by ``require``, before and after, or if ``out`` cannot be written.
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


def record_source(capture: Path, source: Path) -> None:
    """Record the source photos or video of a capture, so that no output replaces them."""
    names = {"sources": [os.path.abspath(source)]}
    write_text(capture / SOURCES_NAME, json.dumps(names, indent=1) + "\n")


def _sources(capture: Path) -> set[Path]:
    try:
        names = json.loads(read_limited(capture / SOURCES_NAME))["sources"]
        return {Path(name) for name in names}
    except Exception:  # a missing or damaged file costs no more than this protection
        return set()


if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

LOCK_NAME = "run.lock"
"""File that exists while a process writes into the folder; one left by a killed process has no
effect."""

_HELD = (errno.EAGAIN, errno.EACCES, errno.EWOULDBLOCK, errno.EDEADLK)
_WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)
_WAIT = 1.0  # seconds between two looks at a folder that another process makes
_FAR = 2**30
"""Offset of the locked byte on Windows, past the end of the file: a locked byte cannot be read by
others."""


class InUseError(DyngsError):
    """Another process writes into the folder."""


@contextmanager
def lock_folder(folder: Path) -> Iterator[bool]:
    """Lock a folder for writing; yields false where the file system has no locks.

    The folder is created if missing, and removed if it stays empty. ``run.lock`` records the
    writer. A missing lock is logged as a warning.

    Raises:
        InUseError: another process writes there.
        DyngsError: it cannot be written, or a link leads out of the folder.
    """
    require_within_run(folder)
    links = find_escaping_links(folder)
    if links:
        raise DyngsError(
            f"{links[0][0]}: is a link to {links[0][1]}, outside the output folder {folder}; "
            "remove it"
        )
    made = _made(folder)
    try:
        file, is_locked = _locked(folder / LOCK_NAME)
        try:
            yield is_locked
        finally:
            _freed(folder / LOCK_NAME, file)
    finally:
        for path in made:
            with suppress(OSError):
                path.rmdir()  # only succeeds if nothing came of it


def make_once(
    folder: Path, make: Callable[[], None], log: Callable[[str], None], found: str
) -> None:
    """Create a folder of the cache by calling ``make``, or print ``found`` if it exists.

    One of several processes creates it, the others wait for it. Without file locks each of them
    calls ``make``, and the first result is kept. Raises DyngsError: as ``make`` does, or the cache
    cannot be written.
    """
    path = folder.with_name(f".{folder.name}.lock")
    _made(folder.parent)
    is_told = False
    while not folder.is_dir():
        try:
            file, _ = _locked(path)
        except InUseError:
            if not is_told:
                log(f"{folder}: {_owner(path)}; waiting for its result")
            is_told = True
            time.sleep(_WAIT)
            continue
        try:
            if not folder.is_dir():
                make()
                return
        except DyngsError:
            if not folder.is_dir():
                raise
        finally:
            _freed(path, file)
    log(found)


def _made(folder: Path) -> list[Path]:
    """Return the folders that had to be made, innermost first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise DyngsError(f"{folder}: is not a folder; choose another one") from None
    except OSError as error:
        raise DyngsError(f"cannot write {folder}: {error.strerror or error}") from error
    return missing


def _locked(path: Path) -> tuple[int, bool]:
    """Open the lock file ``path``; return it and whether it is locked."""
    folder = path.parent
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
    while True:
        require_regular_file(path)
        try:
            file = os.open(path, flags, 0o666)
        except OSError as error:
            raise DyngsError(f"cannot write {path}: {error.strerror or error}") from error
        try:
            _lock(file)
        except OSError as error:
            if error.errno in _WITHOUT_LOCKS:
                log_warning(
                    f"{folder}: this file system has no file locks ({error.strerror}); "
                    "do not run two commands on that folder at the same time"
                )
                return file, False
            os.close(file)
            if error.errno not in _HELD:
                raise DyngsError(f"cannot lock {path}: {error.strerror or error}") from error
            raise InUseError(
                f"{folder}: {_owner(path)}; wait until it has finished, or choose another folder"
            ) from None
        if _is_the_same(file, path):  # its last owner may have removed it after we had opened it
            break
        os.close(file)
    owner = {"pid": os.getpid(), "host": platform.node(), "since": time.strftime("%F %T")}
    with suppress(OSError):  # without room on the disk nobody is told
        os.ftruncate(file, 0)
        os.lseek(file, 0, os.SEEK_SET)
        os.write(file, (json.dumps(owner) + "\n").encode())
    return file, True


def _lock(file: int) -> None:
    if sys.platform == "win32":
        os.lseek(file, _FAR, os.SEEK_SET)
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
    else:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _freed(path: Path, file: int) -> None:
    """Remove and close the lock file; waiting processes notice that it is gone."""
    with suppress(OSError):
        if sys.platform != "win32" and _is_the_same(file, path):
            path.unlink()
    with suppress(OSError):
        os.close(file)
    if sys.platform == "win32":
        with suppress(OSError):
            path.unlink()  # fails if somebody has it by now


def _is_the_same(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.stat(path))
    except OSError:
        return False


def _owner(path: Path) -> str:
    """Return a description of the process in the lock file."""
    try:
        with path.open("rb") as file:
            known = json.loads(file.read(4096))
        return "process {pid} on {host} has been writing there since {since}".format(**known)
    except (OSError, ValueError, KeyError, TypeError):
        return "another process is writing there"
