"""Atomic writing of files, text and images: a file appears complete or not at all. Temporary files,
the user's cache, and error texts of OpenImageIO."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import secrets
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dyngs.core.errors import DyngsError, format_one_line

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


def cache_folder(
    kind: Literal["frames", "poses", "bodies", "people", "captures", "motion"],
) -> Path:
    """Return the folder of one kind of cached files: in ``$DYNGS_CACHE_DIR``, else in the user's
    cache."""
    chosen = os.environ.get(CACHE_VARIABLE, "")
    if chosen:
        return Path(chosen).expanduser().absolute() / kind
    from platformdirs import user_cache_path

    return user_cache_path("dyngs", appauthor=False) / kind


@contextmanager
def atomic_file(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """Yield a temporary path next to ``path``; it replaces ``path`` if the block succeeds and is
    removed otherwise.

    The folder is created if missing; the temporary name keeps the suffix, by which writers choose
    the format. ``durable``: wait until it is on disk, so that a power cut leaves the old file or
    the new one, complete.
    """
    require_replaceable(path)
    try:
        temporary = temporary_beside(path)
    except OSError as error:
        raise DyngsError(f"cannot write {path}: {error.strerror or error}") from error
    try:
        yield temporary
        if durable:
            _flush(temporary, os.O_RDWR)
        os.replace(temporary, path)
        if durable:
            with suppress(OSError):  # not every system can flush a folder
                _flush(path.parent, os.O_RDONLY)
    except OSError as error:
        raise DyngsError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def require_replaceable(path: Path) -> None:
    """Check that a file may be written in the place of ``path``: there is nothing, a file or a
    folder.

    Raises DyngsError: a device, a pipe or the like; or a place in /dev or /proc, such as
    /dev/stdout.
    """
    parent = os.path.realpath(path.parent)
    is_file = parent != "/dev" and not parent.startswith("/proc/")
    with suppress(OSError):
        mode = os.stat(path).st_mode
        is_file = is_file and (stat.S_ISREG(mode) or stat.S_ISDIR(mode))
    if not is_file:
        raise DyngsError(f"cannot write {path}: not a regular file; give a file name")


def _flush(path: Path, flags: int) -> None:
    """Wait until a file, or the names in a folder, are on disk."""
    opened = os.open(path, flags)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def write_text(path: Path, text: str, *, durable: bool = False) -> None:
    """Write ``text`` as UTF-8, atomically; ``durable`` as in ``atomic_file``."""
    with atomic_file(path, durable=durable) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_image(path: Path, pixels: np.ndarray, png_level: int = 6) -> None:
    """Write an image, atomically; the suffix names the format.

    Args:
        path: ``.png`` or ``.jpg`` (8 bit), ``.exr`` (float32), or what else OpenImageIO writes.
        pixels: (H, W) or (H, W, C); uint8 and uint16 as they are, or floats, which are clamped to
            [0, 1] for 8-bit formats. A fourth channel is alpha: straight for PNG, premultiplied for
            EXR, as these formats want it.
        png_level: compression of PNG, 0 to 9.
    """
    import OpenImageIO as oiio

    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    if pixels.ndim != 3 or 0 in pixels.shape:
        raise ValueError(f"pixels must be (H, W) or (H, W, C), got {pixels.shape}")
    if path.suffix.lower() == ".exr":
        pixels = pixels.astype(np.float32)
        kind = oiio.FLOAT
    elif pixels.dtype == np.uint16:
        kind = oiio.UINT16
    else:
        pixels = to_uint8(pixels)
        kind = oiio.UINT8
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, kind)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    spec.attribute("png:compressionLevel", png_level)
    with atomic_file(path) as temporary:
        output = oiio.ImageOutput.create(str(temporary))
        if output is None:
            image_error(oiio)  # must be fetched, or it is printed when the program ends
            raise DyngsError(
                f"cannot write {path}: no format has the suffix '{path.suffix}' (use .png or .exr)"
            )
        written = output.open(str(temporary), spec) and output.write_image(
            np.ascontiguousarray(pixels)
        )
        problem = image_error(output)
        if not (output.close() and written):
            raise DyngsError(
                f"cannot write {path}: {problem or image_error(output) or 'unknown error'}"
            )


def to_uint8(pixels: np.ndarray) -> np.ndarray:
    """Return the image as uint8; floats in [0, 1] are rounded, NaN becomes 0."""
    if pixels.dtype == np.uint8:
        return pixels
    clean = np.nan_to_num(pixels.astype(np.float32), nan=0.0)
    return (np.clip(clean, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def image_error(source: Any) -> str:
    """Return the last error of OpenImageIO, or of one of its readers and writers, as one short
    line, "" if there is none."""
    text = read_lenient_text(source.geterror).strip()
    return format_one_line(text.splitlines()[0], 100) if text else ""


def read_lenient_text(ask: Callable[[], str]) -> str:
    """Return the text of ``ask``; bytes that are not UTF-8, at which OpenImageIO's binding raises,
    as escapes."""
    try:
        return ask()
    except UnicodeDecodeError as error:
        return error.object.decode("utf-8", "backslashreplace")
