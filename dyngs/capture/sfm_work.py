"""The folder in which structure from motion works: found again by the next try where one was stopped."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from dyngs.errors import DyngsError
from dyngs.files.write import write_text

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

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
