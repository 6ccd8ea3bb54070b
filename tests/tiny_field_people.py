"""Small synthetic people, and networks that predict fields of them, for tests."""

from __future__ import annotations

from pathlib import Path

from dyngs.config import Config, DataConfig
from dyngs.data.read import list_captures
from dyngs.human.body.body_reader import default_template
from dyngs.human.predict.people import Person, read_captured_person
from dyngs.human.synthetic.capture import PeopleOptions, write_people

NETWORKS = ("eg_human_nerf", "keypoint_nerf")


def field_people(folder: Path, people: int = 2, cameras: int = 8) -> Path:
    return write_people(folder, PeopleOptions(people, size=40, cameras=cameras, seed=3))


def field_config(
    kind: str, folder: Path, run: Path, model: dict[str, object] | None = None, **train: object
) -> Config:
    """Of four steps with a checkpoint after every second one; ``train`` changes that, ``model`` the
    network."""
    return Config.model_validate(
        {
            "data": {"root": folder},
            "model": {"kind": kind, "source_views": 3} | (model or {}),
            "train": {"steps": 4, "save_every": 2, "alpha_weight": 0.1} | train,
            "run": {"dir": run, "threads": 1},
        }
    )


def first_person(folder: Path) -> Person:
    return read_captured_person(list_captures(DataConfig(root=folder))[0], default_template())
