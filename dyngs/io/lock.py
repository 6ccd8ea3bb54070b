"""A lock for one writer at a time in a folder, released by the system when its process ends,
however it ends."""

from __future__ import annotations

import errno
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dyngs.core.errors import DyngsError, require_regular, warn
from dyngs.io.containment import leaving_links
from dyngs.io.outputs import require_within_run

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
def writing(folder: Path) -> Iterator[bool]:
    """Yield whether no other process writes into the folder in the block, which is not known where
    its file system has no locks.

    The folder is made where it is missing, and removed where nothing came of it. The file
    ``run.lock`` says who writes. A file system that has no locks (some network file systems) is
    told of in a line on stderr.

    Raises:
        InUseError: another process writes there.
        DyngsError: nobody can; a link leads out of the folder.
    """
    require_within_run(folder)
    links = leaving_links(folder)
    if links:
        raise DyngsError(
            f"{links[0][0]}: is a link to {links[0][1]}, out of {folder}, which is written to; remove it"
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
    folder: Path, make: Callable[[], None], say: Callable[[str], None], found: str
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
                say(f"{folder}: {_owner(path)}; its result is waited for")
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
    say(found)


def _made(folder: Path) -> list[Path]:
    """Return the folders that had to be made, innermost first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise DyngsError(f"{folder}: is not a folder; give another one") from None
    except OSError as error:
        raise DyngsError(f"cannot write {folder}: {error.strerror or error}") from error
    return missing


def _locked(path: Path) -> tuple[int, bool]:
    """Return the lock file ``path``, open, and whether it is locked."""
    folder = path.parent
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
    while True:
        require_regular(path)
        try:
            file = os.open(path, flags, 0o666)
        except OSError as error:
            raise DyngsError(f"cannot write {path}: {error.strerror or error}") from error
        try:
            _lock(file)
        except OSError as error:
            if error.errno in _WITHOUT_LOCKS:
                warn(
                    f"{folder}: this file system has no locks ({error.strerror}); "
                    "see to it that no two commands write into that folder at once"
                )
                return file, False
            os.close(file)
            if error.errno not in _HELD:
                raise DyngsError(f"cannot lock {path}: {error.strerror or error}") from error
            raise InUseError(
                f"{folder}: {_owner(path)}; wait until it has ended, or give another folder"
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
    """Remove and close the lock file; others that wait to lock it notice that it is gone."""
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
    """Return the process that writes there, as far as the lock file says."""
    try:
        with path.open("rb") as file:
            known = json.loads(file.read(4096))
        return "process {pid} on {host} has been writing there since {since}".format(**known)
    except (OSError, ValueError, KeyError, TypeError):
        return "another process is writing there"
