"""What a capture from somebody else may do while it is read: where its files may lie, how large its pictures may be.

It may name any file of the user as one of its pictures, by a link, an absolute path or ``..``, and a picture of a few
kilobytes may fill all memory. Each file is looked at here before it is opened, each picture before it is decoded.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from dyngs.errors import DyngsError, require_regular

MAX_MEGAPIXELS = 150.0
"""1e6 pixels that a picture may have unless the configuration says otherwise."""
_MAX_LISTED = 100_000
"""Entries of a capture that are looked through for links."""


@dataclass(frozen=True)
class _Border:
    """Where files may lie: below ``real``, which is ``root`` without links. ``folders``: real places already known."""

    root: Path
    real: str
    folders: dict[str, str] = field(default_factory=dict)

    def real_place(self, path: Path) -> str:
        """The path without links; that of a folder is looked up once."""
        folder, name = os.path.split(path)
        if name in ("", ".", "..") or os.path.islink(path):
            return os.path.realpath(path)
        if folder not in self.folders:
            self.folders[folder] = os.path.realpath(folder)
        return os.path.join(self.folders[folder], name)


_border: ContextVar[_Border | None] = ContextVar("border", default=None)
_max_megapixels: ContextVar[float] = ContextVar("max_megapixels", default=MAX_MEGAPIXELS)


@contextmanager
def staying_within(root: Path, follow_links: bool = False) -> Iterator[None]:
    """A block in which ``inside`` refuses what does not lie below ``root``; nothing is refused if ``follow_links``."""
    token = _border.set(None if follow_links else _Border(root, os.path.realpath(root)))
    try:
        yield
    finally:
        _border.reset(token)


@contextmanager
def pictures_up_to(megapixels: float) -> Iterator[None]:
    """A block in which pictures may have so many 1e6 pixels, in place of ``MAX_MEGAPIXELS``."""
    token = _max_megapixels.set(megapixels)
    try:
        yield
    finally:
        _max_megapixels.reset(token)


def inside(path: Path) -> Path:
    """``path``, if it may be opened: outside a block of ``staying_within`` any path may.

    Raises:
        DyngsError: it lies outside the capture, says where; it is a pipe or a device.
    """
    border = _border.get()
    if border is not None:
        _require_below(border, path)
    require_regular(path)
    return path


def _require_below(border: _Border, path: Path) -> None:
    place = border.real_place(path)
    if not _is_below(place, border.real):
        leads = "" if place == str(path) else f" leads to {place}, which"
        raise DyngsError(
            f"{path}:{leads} lies outside the capture {border.root}; copy the file into the capture, or, if you trust "
            "it to name files of yours, set data.follow_links=true"
        )


def check_size(path: Path, width: int, height: int, channels: int = 4) -> None:
    """Check that a picture is not too large to be decoded; more than four channels count as so many pictures.

    Raises:
        DyngsError: it has more pixels than are allowed; says how many and which key allows more.
    """
    megapixels, limit = width * height * max(channels / 4, 1) / 1e6, _max_megapixels.get()
    if megapixels > limit:
        many = f" of {channels} channels" if channels > 4 else ""
        raise DyngsError(
            f"{path}: {width}x{height} pixels{many} are {megapixels:.5g} megapixels, but data.max_megapixels is "
            f"{limit:g}; shrink the picture, or raise it if there is memory for that (some 30 MB per megapixel)"
        )


def max_decoded_mb() -> int:
    """What a picture of the largest size takes in 2^20 bytes, with four channels of floats."""
    return max(1, round(_max_megapixels.get() * 16e6 / 2**20))


def leaving_links(root: Path) -> list[tuple[Path, str]]:
    """Links below ``root`` (its first 100,000 entries) that lead out of it, and where to; no link is followed."""
    real = os.path.realpath(root)
    found, seen = [], 0
    for folder, names, files in os.walk(root):
        for name in sorted((*names, *files)):
            path = Path(folder, name)
            if os.path.islink(path) and not _is_below(os.path.realpath(path), real):
                found.append((path, os.path.realpath(path)))
        seen += len(names) + len(files)
        if seen > _MAX_LISTED:
            break
    return found


def _is_below(place: str, real_root: str) -> bool:
    return place == real_root or place.startswith(real_root.rstrip(os.sep) + os.sep)
