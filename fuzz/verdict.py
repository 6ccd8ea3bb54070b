"""Verdicts: a reader must return finite values or refuse with one clear line, and must change no
other files."""

from __future__ import annotations

import math
import os
import re
import sys
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

LONGEST = 800
"""Longest error in characters, paths in the case's folder counted as one; lists of configuration
keys take 600."""
_WAY = re.compile(r"F/\S*")


class Outcome(str, Enum):
    """Outcome of a case."""

    ACCEPTED = "accepted"
    REFUSED = "refused"
    FAILED = "failed"


@dataclass(frozen=True)
class Verdict:
    """Outcome of a case and the reason.

    Attributes:
        outcome: accepted, refused or failed.
        reason: the same for failures at the same place; the error of a refusal.
        detail: description of a failure.
    """

    outcome: Outcome
    reason: str = ""
    detail: str = ""


def fault_of_message(message: str, folder: Path, names: set[str] | None) -> str | None:
    """Return the fault of an error's text, None if it has none.

    Args:
        message: the text.
        folder: folder of the case.
        names: names of its files; the text must contain one of them or the folder. None: it need
            not.
    """
    odd = [c for c in message if unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") or c in _BIDI]
    if odd:
        return (
            "the error holds a line break"
            if odd[0] in "\n\r"
            else "the error holds a control character"
        )
    if len(_WAY.sub("F", message.replace(str(folder), "F"))) > LONGEST:
        return "the error is too long"
    if not message.strip():
        return "the error is empty"
    if (
        names is not None
        and str(folder) not in message
        and not any(name in message for name in names)
    ):
        return "the error names no file"
    return None


_BIDI = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"


def not_finite(value: object) -> str | None:
    """Return the place of a number that is not finite in a result, None if there is none."""
    return next(_not_finite(value, "result", 0), None)


def _not_finite(value: object, where: str, depth: int) -> Iterator[str]:
    if depth > 12 or isinstance(value, (str, bytes, Path, int, type(None))):
        return
    if isinstance(value, float):
        if not math.isfinite(value):
            yield where
    elif isinstance(value, Tensor):
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            yield where
    elif isinstance(value, (np.ndarray, np.number)):
        if value.dtype.kind in "fc" and not np.isfinite(value).all():
            yield where
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _not_finite(item, f"{where}.{key}", depth + 1)
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _not_finite(item, f"{where}[]", depth + 1)
    elif is_dataclass(value):
        for part in fields(value):
            yield from _not_finite(getattr(value, part.name), f"{where}.{part.name}", depth + 1)


Snapshot = dict[str, tuple[int, ...] | str]


def snapshot(folder: Path) -> Snapshot:
    """Map every path below ``folder`` to its size, time and kind; links are not followed."""
    found: Snapshot = {}
    stack = [str(folder)]
    while stack:
        with os.scandir(stack.pop()) as entries:
            for entry in entries:
                state = entry.stat(follow_symlinks=False)
                if entry.is_dir(follow_symlinks=False):
                    found[entry.path] = (state.st_mode,)
                    stack.append(entry.path)
                else:
                    found[entry.path] = (
                        state.st_mode,
                        state.st_size,
                        state.st_mtime_ns,
                        state.st_ino,
                    )
    return found


def difference(before: Snapshot, after: Snapshot) -> str | None:
    """Return the first path that was written, removed or changed, None if all are the same."""
    for path in sorted(before.keys() | after.keys()):
        if path not in after:
            return f"removed {path}"
        if path not in before:
            return f"wrote {path}"
        if before[path] != after[path]:
            return f"changed {path}"
    return None


class Forbidden(BaseException):
    """A forbidden operation that a reader tried."""


class Guard:
    """Audit hook that refuses forbidden operations: writing outside some folders, starting
    programs, opening sockets.

    The hook stays until the process ends. It does not see what a library does in C: ``snapshot``
    does.
    """

    _WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
    _CHANGES = (
        "os.remove",
        "os.rmdir",
        "os.mkdir",
        "os.rename",
        "os.link",
        "os.symlink",
        "os.truncate",
        "os.chmod",
        "os.utime",
        "shutil.rmtree",
        "shutil.move",
    )
    _NEVER = ("os.system", "os.exec", "socket.connect", "pty.spawn")

    def __init__(self, allowed: tuple[Path, ...]) -> None:
        self.given = allowed
        self.allowed = tuple(os.path.realpath(path) for path in allowed)
        self.active = False
        self.tried: str | None = None
        sys.addaudithook(self._hook)

    def _hook(self, event: str, arguments: tuple[object, ...]) -> None:
        if not self.active:
            return
        if event in self._NEVER:
            self._refuse(f"{event} {arguments[:1]}")
        elif event == "open":
            flags = arguments[2]
            if (
                isinstance(flags, int)
                and flags & self._WRITES
                and isinstance(arguments[0], (str, bytes, os.PathLike))
            ):
                self._check(event, arguments[0], None)
        elif event in self._CHANGES:
            places = (
                arguments[:2] if event in ("os.rename", "os.link", "shutil.move") else arguments[:1]
            )
            if event == "os.symlink":
                places = arguments[1:2]
            folder = next(
                (a for a in arguments[1:] if type(a) is int and a >= 0 and event != "os.chmod"),
                None,
            )
            for place in places:
                if isinstance(place, (str, bytes, os.PathLike)):
                    self._check(
                        event,
                        place,
                        folder if event in ("os.remove", "os.rmdir", "os.mkdir") else None,
                    )

    def _check(self, event: str, place: str | bytes | os.PathLike, folder: int | None) -> None:
        path = os.fsdecode(place)
        if folder is not None and not os.path.isabs(path) and event != "os.mkdir":
            path = os.path.join(os.readlink(f"/proc/self/fd/{folder}"), path)
        self.active = False
        try:
            head = os.path.realpath(os.path.dirname(os.path.abspath(path)))
        finally:
            self.active = True
        is_there = event == "os.mkdir" and os.path.isdir(path)
        if (
            path != os.devnull
            and not is_there
            and not any(head == own or head.startswith(own + os.sep) for own in self.allowed)
        ):
            self._refuse(f"{event} {path}")

    def _refuse(self, what: str) -> None:
        self.tried = what
        raise Forbidden(what)
