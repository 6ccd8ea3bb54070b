"""Many synthetic people, a capture each, for networks that learn to predict people."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from dyngs.core.conventions import ReportProgress, report_nothing
from dyngs.core.errors import DyngsError
from dyngs.data.people_set import PEOPLE_FILE
from dyngs.human.synthetic.capture import HumanOptions, varied, write_human_capture
from dyngs.io.outputs import require_new_folder
from dyngs.io.write import write_text

SHARD = 100
"""People in a folder."""
_MOST = 10**6  # People of one seed, so that those of two seeds share nothing


@dataclass(frozen=True)
class PeopleOptions:
    """Options of a set of synthetic people."""

    people: int = 100
    size: int = 256  # width and height of the images, px
    cameras: int = 24  # on a ring around each person
    frames: int = 1  # of a clip of each person
    seed: int = 0  # people of different seeds have no body, outfit, clip, light or ring in common


def write_people(
    out: Path, options: PeopleOptions = PeopleOptions(), report: ReportProgress = report_nothing
) -> Path:
    """Write people as ``out/SHARD/PERSON``, captures of ``write_human_capture`` with depth maps and
    key points.

    Every person has a body, an outfit, a clip, a light and a ring of cameras of their own; every
    other one wears usual clothes. The same options give the same bytes. One person is in memory at
    a time. Where ``out`` holds people of the same options already, the missing ones are added: a
    set may be written in parts, and trained on meanwhile. Raises DyngsError: options out of range,
    or a folder that holds something else.
    """
    if not (
        1 <= options.people <= _MOST and min(options.size, options.cameras, options.frames) >= 1
    ):
        raise DyngsError(
            f"people need size, cameras and frames of at least 1, and be 1 to {_MOST:,}"
        )
    if options.seed < 0:
        raise DyngsError("people need a seed of at least 0")
    _begin(out, {name: value for name, value in asdict(options).items() if name != "people"})
    for number in range(options.people):
        person = out / f"s{number // SHARD:04d}" / f"p{number:06d}"
        if not person.is_dir():
            write_human_capture(person, person_options(options, number))
        report("people", number + 1, options.people)
    return out


def _begin(out: Path, made_with: dict[str, int]) -> None:
    """Write that people in ``out`` are made with these options, or check that they were."""
    mark = out / PEOPLE_FILE
    text = json.dumps(made_with) + "\n"
    if not mark.is_file():
        require_new_folder(out)
        write_text(mark, text)
    elif mark.read_text(encoding="utf-8", errors="replace") != text:
        raise DyngsError(
            f"{out}: holds people of other options ({PEOPLE_FILE}); name a new folder, or give the same"
        )


def person_options(options: PeopleOptions, number: int) -> HumanOptions:
    """Return the options of the person ``number``, from 0."""
    seed = options.seed * _MOST + number + 1  # 0 would be the bare template
    person = HumanOptions(
        size=options.size,
        num_frames=options.frames,
        num_new=0,
        num_cameras=options.cameras,
        num_test=0,
        usual_clothes=number % 2 == 1,
        ring_seed=seed,
        with_truth=True,
    )
    return varied(person, seed)
