"""Declaration of a capture format, one per reader module."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dyngs.data.capture import Capture


@dataclass(frozen=True)
class CaptureFormat:
    """A capture format: how a folder of this format is recognised and read.

    Attributes:
        name: as in ``data.format`` and ``Capture.format``; also the name of the reader module.
        files: the files by which it is recognised, for messages.
        recognise: whether a folder holds these files; opens none of them.
        read: reads the folder; ``dyngs.data.read`` then finishes splits and times.
        extends: name of the format of which this one is a special case: its folders are recognised as that one, too.
    """

    name: str
    files: str
    recognise: Callable[[Path], bool]
    read: Callable[[Path], Capture]
    extends: str | None = None
