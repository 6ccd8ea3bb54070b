"""What a person says about the videos of a folder, in ``videos.json`` beside them: offsets, and cameras for testing."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dyngs.errors import DyngsError
from dyngs.files.fields import first_few, is_number, read_json_object

NAME = "videos.json"
MAX_SECONDS = 86_400.0


@dataclass(frozen=True)
class Given:
    """What is known of several videos beforehand.

    Attributes:
        starts: camera to the second, in one clock, at which its first frame was taken; None: to be found.
        test: cameras that are held out; None: the usual rule.
    """

    starts: dict[str, float] | None = None
    test: tuple[str, ...] | None = None


def read_given(folder: Path, names: Sequence[str]) -> Given:
    """Read ``videos.json``: ``{"starts": {"cam00": 0, "cam01": 1.25}, "test": ["cam00"]}``; all keys are optional.

    ``"starts": 0`` says that all videos begin at the same moment.

    Args:
        folder: the videos' folder.
        names: of all cameras.

    Raises:
        DyngsError: a camera that is not there or missing, or something that is no number.
    """
    path = folder / NAME
    if not path.is_file():
        return Given()
    fields = read_json_object(path)
    unknown = sorted(fields.keys() - {"starts", "test"})
    if unknown:
        raise DyngsError(f"{path}: unknown key {unknown[0]!r:.60}; there are 'starts' and 'test'")
    test = fields.get("test")
    if test is not None and not (isinstance(test, list) and all(name in names for name in test)):
        raise DyngsError(f"{path}: 'test' must list cameras of {first_few(sorted(names))}, got {test!r:.80}")
    if test is not None and set(test) == set(names):
        raise DyngsError(f"{path}: 'test' names all cameras, which leaves none to train on")
    starts = fields.get("starts")
    if starts == 0 and is_number(starts):
        starts = dict.fromkeys(names, 0.0)
    elif starts is not None and not isinstance(starts, dict):
        raise DyngsError(f"{path}: 'starts' must map cameras to seconds, or be 0, got {starts!r:.40}")
    return Given(
        None if starts is None else checked_starts(starts, names, str(path)), None if test is None else tuple(test)
    )


def checked_starts(starts: Mapping[str, object], names: Sequence[str], where: str) -> dict[str, float]:
    """Return the seconds at which the videos begin, for every camera.

    Args:
        starts: camera to seconds, as given.
        names: of all cameras.
        where: they are from, for messages.

    Raises:
        DyngsError: a camera that is not there or missing, or something that is no number of at most a day.
    """
    unknown = sorted(starts.keys() - set(names))
    missing = sorted(set(names) - starts.keys())
    if unknown:
        raise DyngsError(f"{where}: no video is called {first_few(unknown)}; there are {first_few(sorted(names))}")
    if missing:
        raise DyngsError(f"{where}: says nothing on {first_few(missing)}; give the second at which every video begins")
    for name, second in starts.items():
        if not (is_number(second) and math.isfinite(second) and abs(second) <= MAX_SECONDS):
            raise DyngsError(f"{where}: the start of {name} must be a number of seconds, got {second!r:.40}")
    return {name: float(second) for name, second in starts.items() if is_number(second)}
