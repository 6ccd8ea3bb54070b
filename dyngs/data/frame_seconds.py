"""Seconds at which the images of a capture were taken, in a file beside them: ``times.json``.

COLMAP's models have no times. ``dyngs data sfm`` writes this file for the frames of a video.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from dyngs.errors import DyngsError
from dyngs.files.fields import is_number, read_json_object
from dyngs.files.write import write_text

NAME = "times.json"


def write_seconds(root: Path, seconds: Mapping[str, float]) -> None:
    """Write the second of each image, by its path below ``root/images``."""
    write_text(root / NAME, json.dumps({"seconds": dict(seconds)}, indent=1) + "\n")


def read_seconds(root: Path) -> dict[str, float]:
    """Read the second of each image, by its path below ``root/images``; empty without the file.

    Raises:
        DyngsError: the file is damaged, or something in it is no number.
    """
    path = root / NAME
    if not path.is_file():
        return {}
    seconds = read_json_object(path).get("seconds")
    if not isinstance(seconds, dict):
        raise DyngsError(f"{path}: needs an object 'seconds' of image names and seconds; see docs/formats.md")
    for name, second in seconds.items():
        if not is_number(second):
            raise DyngsError(f"{path}: the second of {name:.60} must be a number, got {second!r:.40}")
    return {str(name): float(second) for name, second in seconds.items()}
