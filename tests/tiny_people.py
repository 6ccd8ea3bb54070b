"""Small synthetic captures of people, for tests of predictions."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import torch

from dyngs.config import Config, DataConfig
from dyngs.core.conventions import ignore_progress
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import default_template
from dyngs.human.keys import HumanPredictorModel
from dyngs.human.predict.ghg.network import (
    AtlasNetwork,
    AtlasPerson,
    PersonPredictor,
    read_atlas_person,
)
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture
from dyngs.models.checkpoint import Checkpoint, CheckpointInfo

TINY = HumanOptions(size=32, num_frames=1, num_pose_frames=1, num_cameras=8, num_test=1, samples=1)
NET = HumanPredictorModel(
    sh_degree=0,
    resolution=32,
    scaffold_heights=(0.0, 0.02),
    source_views=3,
)


@cache
def body() -> BodyTemplate:
    return default_template()


def people(folder: Path, seeds: tuple[int, ...], options: HumanOptions = TINY) -> Path:
    """Write a capture of a person per seed into ``folder``; return it."""
    for seed in seeds:
        write_human_capture(folder / f"p{seed}", replace(options, seed=seed))
    return folder


def person(capture: Path, model: HumanPredictorModel = NET) -> AtlasPerson:
    """The person of one capture."""
    return read_atlas_person(DataConfig.model_validate({"root": capture}), model, body())


def untrained_predictor(capture: Path) -> PersonPredictor:
    """An untrained network with the person of one capture; mean colours are grey."""
    weights = AtlasNetwork(NET, torch.Generator().manual_seed(0)).state_dict()
    tensors = {f"model.network.{name}": x for name, x in weights.items()}
    tensors["model.mean"] = torch.full((3, NET.resolution, NET.resolution), 0.5)
    info = CheckpointInfo(0, 1.0, (0.0, 0.0, 0.0), "white", "classic")
    values = {"data": {"root": capture}, "model": NET, "train": {"alpha_weight": 0.1}}
    whole = Config.model_validate(values)
    return PersonPredictor(whole, Checkpoint(info, tensors), whole.data, print, ignore_progress)


def config(folder: Path, run: Path, **changes: object) -> Config:
    """Of four steps with a checkpoint after every two, with some changes of the model section."""
    return Config.model_validate(
        {
            "data": {"root": folder},
            "model": NET.model_dump() | changes,
            "train": {"steps": 4, "save_every": 2, "alpha_weight": 0.1},
            "run": {"dir": run, "threads": 1},
        }
    )
