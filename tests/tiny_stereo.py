"""Small synthetic people with depth maps, and a small stereo network, for tests of predictions from
pairs of views."""

from __future__ import annotations

from pathlib import Path

from dyngs.config import Config
from dyngs.human.predict.kind import GpsModel
from dyngs.human.synthetic.capture import PeopleOptions, write_people

STEREO = GpsModel(person_px=32)
RECURRENT = GpsModel(person_px=32, matching="recurrent", channels=24, updates=2)
PEOPLE = PeopleOptions(people=2, size=40, cameras=24)


def stereo_config(folder: Path, run: Path, model: GpsModel = STEREO, **train: object) -> Config:
    """Of four steps, two of depth alone, with a checkpoint after every second one; ``train``
    changes that."""
    return Config.model_validate(
        {
            "data": {"root": folder},
            "model": model.model_dump(),
            "train": {"steps": 4, "save_every": 2, "alpha_weight": 0.1} | train,
            "run": {"dir": run, "threads": 1},
        }
    )


def stereo_people(folder: Path, seed: int = 0) -> Path:
    return write_people(
        folder, PeopleOptions(PEOPLE.people, PEOPLE.size, PEOPLE.cameras, seed=seed)
    )
