"""Files that may go: temporary ones next to their targets, those that killed processes left, and
the user's cache."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import secrets
import shutil
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Literal

from dyngs.core.errors import DyngsError

CACHE_VARIABLE = "DYNGS_CACHE_DIR"
_NAME = re.compile(
    r"\.(?P<stem>.+)\.(?P<pid>\d{1,10})-(?P<home>[0-9a-f]{6})(-[0-9a-f]{12})?\.dyngs(?P<suffix>\.[^.]*)?",
    re.DOTALL,
)


def temporary_beside(path: Path) -> Path:
    """Create a hidden empty file next to ``path``, with its suffix, and the folder if missing.

    Its name cannot be guessed: in a shared folder nobody can plant a link there. Temporary files
    that killed processes left in that folder are removed, once per folder and process.
    """
    temporary = _unused_name(path)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0)
    os.close(os.open(temporary, flags, 0o666))
    return temporary


def temporary_folder_beside(path: Path) -> Path:
    """Create an empty temporary folder, to be renamed to ``path``."""
    try:
        folder = _unused_name(path)
        folder.mkdir()
    except OSError as error:
        raise DyngsError(f"cannot write {path}: {error.strerror or error}") from error
    return folder


def _unused_name(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_once(str(path.parent.absolute()), os.getpid())
    return path.with_name(
        f".{path.stem}.{os.getpid()}-{_home()}-{secrets.token_hex(6)}.dyngs{path.suffix}"
    )


def remove_leftovers(folder: Path, only_ours: Callable[[str], bool] | None = None) -> None:
    """Remove the temporary files and folders directly in ``folder`` whose processes have ended;
    never through links.

    Processes are known to have ended where they ran under the same operating system as this one.
    ``only_ours``: whether no other process writes a file of this name at present; then they go
    whatever process they are of.
    """
    try:
        entries = list(os.scandir(folder))
    except OSError:
        return
    for entry in entries:
        match = _NAME.fullmatch(entry.name)
        if match is None or entry.is_symlink():
            continue
        name = match["stem"] + (match["suffix"] or "")
        ended = match["home"] == _home() and not _is_alive(int(match["pid"]))
        if ended or (only_ours is not None and only_ours(name)):
            remove_quietly(Path(entry.path))


def remove_quietly(path: Path) -> None:
    """Remove a regular file, or a folder with its contents, but no link; errors are ignored."""
    if path.is_symlink():
        return
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    elif path.is_file():
        with suppress(OSError):
            path.unlink()


@lru_cache(maxsize=4096)
def _remove_once(folder: str, pid: int) -> None:  # pid: a forked process does this again
    remove_leftovers(Path(folder))


@lru_cache(maxsize=1)
def _home() -> str:
    """Return a name for the machine, and its container if there is one, within which process ids
    are unique."""
    try:
        namespace = os.readlink("/proc/self/ns/pid")
    except OSError:  # not on Linux
        namespace = ""
    return hashlib.sha256(f"{platform.node()} {namespace}".encode()).hexdigest()[:6]


def _is_alive(pid: int) -> bool:
    """Whether a process with this id exists; true where that cannot be found out."""
    if os.name != "posix":  # os.kill would end it there
        return True
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # somebody else's
        return True
    return True


def cache_folder(kind: Literal["frames", "poses", "bodies", "people", "captures"]) -> Path:
    """Return the folder of one kind of cached files: in ``$DYNGS_CACHE_DIR``, else in the user's
    cache."""
    chosen = os.environ.get(CACHE_VARIABLE, "")
    if chosen:
        return Path(chosen).expanduser().absolute() / kind
    from platformdirs import user_cache_path

    return user_cache_path("dyngs", appauthor=False) / kind
