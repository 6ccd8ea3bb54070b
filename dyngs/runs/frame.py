"""The frame that `dyngs edit` gave to a run: RUN/frame.json, by which all that leaves the run is
moved."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path

from dyngs.core.errors import DyngsError
from dyngs.io.fields import read_limited
from dyngs.io.formats.similarity import AXES, UNMOVED, Similarity, similarity_of
from dyngs.io.write import write_text

FRAME_NAME = "frame.json"
_MOST_BYTES = 4096


@dataclass(frozen=True)
class RunFrame:
    """The frame that people mean when they speak of a run that was edited.

    Attributes:
        similarity: from the coordinates of training to those of the frame, less ``offset``.
        offset: (3,) in the frame, for coordinates that are too large for float32.
        up: axis of the frame that is up, such as "z"; None: nothing says.
        fixed: exports keep the axes, as those of control points.
    """

    similarity: Similarity = UNMOVED
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: str | None = None
    fixed: bool = False


def write_frame(folder: Path, frame: RunFrame) -> None:
    """Write the frame of the run in ``folder``, atomically."""
    write_text(
        folder / FRAME_NAME,
        json.dumps(asdict(frame) | {"similarity": frame.similarity.numbers}) + "\n",
    )


def read_frame(folder: Path) -> RunFrame | None:
    """Return the frame of the run in ``folder``, None where it was not edited. Raises DyngsError:
    it is damaged."""
    path = folder / FRAME_NAME
    if not path.exists():
        return None
    try:
        told = json.loads(read_limited(path, _MOST_BYTES))
        similarity = similarity_of([float(a) for a in told["similarity"]])
        x, y, z = map(float, told["offset"])
        up = told["up"]
        fixed = told["fixed"]
        if not math.isfinite(x + y + z) or up not in (None, *AXES) or not isinstance(fixed, bool):
            raise ValueError("no offset or no axis")
    except (DyngsError, ValueError, KeyError, TypeError, RecursionError):
        raise DyngsError(
            f"{path}: is no frame of `dyngs edit`; edit the original run again"
        ) from None
    return RunFrame(similarity, (x, y, z), up, fixed)
