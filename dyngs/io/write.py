"""Atomic writing of files, text and images: a file appears complete or not at all. Error texts of
OpenImageIO."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Protocol

import numpy as np

from dyngs.core.errors import DyngsError, printable
from dyngs.io.temporary import temporary_beside


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
        raise DyngsError(
            f"cannot write {path}: it is a device, a pipe or the like; give the name of a file"
        )


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


def write_image(path: Path, pixels: np.ndarray) -> None:
    """Write an image, atomically; the suffix names the format.

    Args:
        path: ``.png`` or ``.jpg`` (8 bit), ``.exr`` (float32), or what else OpenImageIO writes.
        pixels: (H, W) or (H, W, C); uint8 and uint16 as they are, or floats, which are clamped to
            [0, 1] for 8-bit formats. A fourth channel is alpha: straight for PNG, premultiplied for
                EXR, as these formats want it.
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


class _HasErrors(Protocol):
    """OpenImageIO itself, or one of its readers and writers."""

    def geterror(self) -> str: ...


def image_error(source: _HasErrors) -> str:
    """Return the last error of OpenImageIO as one short line, "" if there is none."""
    text = any_text(source.geterror).strip()
    return printable(text.splitlines()[0], 100) if text else ""


def any_text(ask: Callable[[], str]) -> str:
    """Return the text of ``ask``; bytes that are not UTF-8, at which OpenImageIO's binding raises,
    as escapes."""
    try:
        return ask()
    except UnicodeDecodeError as error:
        return error.object.decode("utf-8", "backslashreplace")
