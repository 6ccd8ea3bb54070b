"""Containment of untrusted captures: their files must be in their folder, their images limited in
size.

A capture may refer to any file of the user by a link, an absolute path or ``..``, and an image of
a few kilobytes may fill all memory. Paths are checked here before opening, images before decoding.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from dyngs.core.errors import DyngsError, require_regular_file

LIMITS_VARIABLE = "DYNGS_LIMITS"
"""Environment variable that scales all limits: 4 allows four times as much."""
MAX_PIXELS = 150_000_000
"""Pixels of an image; decoding takes some 30 bytes of memory for each."""
_MAX_LISTED = 100_000
"""Entries of a capture that are searched for links."""


_boundary: ContextVar[tuple[Path, str] | None] = ContextVar("boundary", default=None)
_links_of_runs: ContextVar[bool] = ContextVar("links_of_runs", default=False)


@contextmanager
def _set(variable: ContextVar[Any], value: object) -> Iterator[None]:
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


def restrict_paths_to(root: Path, follow_links: bool = False) -> AbstractContextManager[None]:
    """Make ``check_inside`` refuse paths outside ``root`` in the block, unless
    ``follow_links``."""
    return _set(_boundary, None if follow_links else (root, os.path.realpath(root)))


def allow_run_links(is_allowed: bool) -> AbstractContextManager[None]:
    """Set whether ``data.follow_links`` holds for runs that are opened in the block.

    The user decides this on the command line: the config.yaml of a run may be that of a stranger.
    """
    return _set(_links_of_runs, is_allowed)


def run_links_allowed() -> bool:
    """Return whether the innermost block of ``allow_run_links`` allows it."""
    return _links_of_runs.get()


def check_inside(path: Path) -> Path:
    """Return ``path`` if it may be opened; without ``restrict_paths_to`` any path may."""
    boundary = _boundary.get()
    if boundary is not None and not _is_below(real := os.path.realpath(path), boundary[1]):
        raise DyngsError(
            f"{path}: points to {real}, outside the capture {boundary[0]}; copy the file into "
            "the capture or, if you trust the capture, set data.follow_links=true"
        )
    require_regular_file(path)
    return path


def scaled_limit(most: int) -> int:
    """Return ``most`` times the value of ``DYNGS_LIMITS`` (default 1)."""
    text = os.environ.get(LIMITS_VARIABLE, "1")
    try:
        factor = float(text)
    except ValueError:
        factor = 0.0
    if not 1 <= factor <= 1e6:
        raise DyngsError(
            f"{LIMITS_VARIABLE}={text:.20} must be a factor from 1 to 1e6 for the default limits"
        )
    return int(most * factor)


def require_at_most(where: Path | str, amount: int, most: int, what: str) -> None:
    """Raise DyngsError if ``amount`` exceeds the limit ``most``, scaled by ``DYNGS_LIMITS``;
    ``what`` is plural."""
    if amount > most and amount > scaled_limit(most):
        shown = f"{amount:,}" if amount < 10**18 else "over 10^18"
        factor = math.ceil(amount / most) if amount < 10**18 else "N"
        raise DyngsError(
            f"{where}: {shown} {what} exceed the limit of {scaled_limit(most):,}; "
            f"if you trust the file, set the environment variable {LIMITS_VARIABLE}={factor}"
        )


def check_size(path: Path, width: int, height: int, channels: int = 4) -> None:
    """Check that an image is not too large to be decoded; more than four channels count in
    proportion."""
    require_at_most(path, width * height * max(channels, 4) // 4, MAX_PIXELS, "pixels")


def max_decoded_mb() -> int:
    """Return the 2^20 bytes that the largest allowed image takes with four channels of floats."""
    return scaled_limit(MAX_PIXELS) * 16 // 2**20


def find_escaping_links(root: Path) -> list[tuple[Path, str]]:
    """List links among the first 100,000 entries below ``root`` that lead out of it, with their
    targets."""
    real = os.path.realpath(root)
    found = []
    seen = 0
    for folder, names, files in os.walk(root):
        for name in sorted((*names, *files)):
            path = Path(folder, name)
            if os.path.islink(path) and not _is_below(os.path.realpath(path), real):
                found.append((path, os.path.realpath(path)))
        seen += len(names) + len(files)
        if seen > _MAX_LISTED:
            break
    return found


def _is_below(real: str, root: str) -> bool:
    return real == root or real.startswith(root.rstrip(os.sep) + os.sep)
