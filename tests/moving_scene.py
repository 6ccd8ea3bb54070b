"""Scenes with known motion, in memory and as a run on disk."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import torch
from scaled_captures import scaled_capture
from torch import Tensor

from dyngs.config import Config, DataConfig, TrainConfig
from dyngs.config.io import RESOLVED_NAME, save_config
from dyngs.core.camera import Cameras
from dyngs.core.state import Role, strip_roles
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.deform.control_nodes import ControlNodes
from dyngs.deform.field import DeformationField, FieldSetup, Offsets, select_rows
from dyngs.deform.fields import field_state
from dyngs.deform.keys import ControlNodesField, DynamicModel
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.optimizer import Parameters
from dyngs.gaussians.static_scene import StaticScene
from dyngs.models.static_section import StaticModel
from dyngs.runs.checkpoint import Checkpoint, CheckpointInfo, save_checkpoint

MOVING_ROWS = (1, 3)
TRAIN_TIMES = (0.0, 0.25, 0.5, 0.75, 1.0)
TEST_TIMES = (0.1, 0.4, 0.9)


SETUP = FieldSetup(torch.zeros(3), torch.ones(3), len(TRAIN_TIMES), len(MOVING_ROWS), 1.0)


@dataclass
class Sliding(DeformationField):
    """All Gaussians move ``speed`` along x from time 0 to 1; counts its evaluations."""

    speed: float = 1.0
    calls: int = 0
    setup: FieldSetup = SETUP
    parameters: Parameters = field(default_factory=lambda: Parameters({}, {}))

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        self.calls += 1
        return Offsets(
            torch.tensor([self.speed * time, 0.0, 0.0]).expand(len(select_rows(means, rows)), 3)
        )


@dataclass
class Blinking(Sliding):
    """All Gaussians are brighter by ``speed`` at every other of ``num_times`` uniform times."""

    num_times: int = 5

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        odd = round(time * (self.num_times - 1)) % 2
        means = select_rows(means, rows)
        return Offsets(
            torch.zeros(len(means), 3), colors=torch.full((len(means), 3), self.speed * odd)
        )


class Lines(DeformationField):
    """Each of M Gaussians moves from -x at time 0 to x at time 1; x is the parameter."""

    def __init__(self, setup: FieldSetup = SETUP) -> None:
        self.setup = setup
        start = {"means": torch.zeros(setup.num_moving, 1, 3)}
        self.parameters = Parameters(start, {"means": 1.6e-4 * setup.extent}, 0.01, Role.PER_MOVING)

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        return Offsets((2 * time - 1) * select_rows(self.parameters["means"], rows)[:, 0])

    def apply_edit(self, edit: TopologyEdit) -> Lines:
        return self.with_parameters(self.parameters.apply_edit(Role.PER_MOVING, edit))


def row_of_balls(count: int = 5) -> Gaussians:
    """Grey balls side by side along x from -1 to 1."""
    means = torch.zeros(count, 3)
    means[:, 0] = torch.linspace(-1, 1, count)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    return Gaussians(
        means,
        quats,
        torch.full((count, 3), -1.6),
        torch.full((count,), 3.0),
        torch.zeros(count, 1, 3),
    )


SLIDING = ControlNodesField(nodes=2, pieces=1, moves=())


def sliding_nodes() -> ControlNodes:
    """Two balls move by 1 along x over time; the middle time is their canonical position."""
    points = torch.zeros(2, 4, 3)
    points[..., 0] = torch.arange(4) - 1.5  # the spline of these is t - 0.5
    moved = row_of_balls().means[list(MOVING_ROWS)]
    field = ControlNodes(SLIDING, SETUP, torch.Generator())
    field.update_nodes(moved)
    field.parameters["means"].data.copy_(points)
    return field


def still_scene(count: int = 5, times: tuple[float, ...] = ()) -> StaticScene:
    """A static scene."""
    return StaticScene(gaussians=row_of_balls(count), training_times=times)


def moving_scene(
    motion: DeformationField,
    rows: tuple[int, ...] = MOVING_ROWS,
    times: tuple[float, ...] = TRAIN_TIMES,
) -> DynamicScene:
    """Five balls, of which ``rows`` move by ``motion``."""
    return DynamicScene(
        gaussians=row_of_balls(), training_times=times, field=motion, moving=torch.tensor(rows)
    )


def camera(width: int = 20, height: int = 14) -> Cameras:
    """A camera at distance 4 in front of the balls."""
    pose = torch.eye(4)
    pose[2, 3] = 4.0
    intrinsics = torch.tensor([[20.0, 0, width / 2], [0, 20, height / 2], [0, 0, 1]])
    return Cameras(pose[None], intrinsics[None], width, height)


def write_timed_capture(root: Path, *, standing: bool = False) -> Path:
    """A capture of 16x16 px at ``TRAIN_TIMES`` and ``TEST_TIMES``; with ``standing`` all test
    images share one pose.
    """
    options = StaticOptions(
        size=16, num_train=len(TRAIN_TIMES), num_test=len(TEST_TIMES), samples=1
    )
    write_static_capture(root, options)
    for split, times in (("train", TRAIN_TIMES), ("test", TEST_TIMES)):
        file = root / f"transforms_{split}.json"
        document = json.loads(file.read_text())
        for frame, time in zip(document["frames"], times, strict=True):
            frame["time"] = time
            if standing and split == "test":
                frame["transform_matrix"] = document["frames"][0]["transform_matrix"]
        file.write_text(json.dumps(document))
    return root


def write_moving_run(
    folder: Path,
    *,
    moves: bool = True,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    standing: bool = False,
) -> Path:
    """A run and its capture: if ``moves``, the second and fourth of five balls move by 1 along x."""
    root = write_timed_capture(
        folder / "at_origin" if any(offset) else folder / "capture", standing=standing
    )
    if any(offset):
        root = scaled_capture(root, folder / "capture", 1.0, offset)
    model = DynamicModel(deform=SLIDING) if moves else StaticModel()
    config = Config(
        data=DataConfig.model_validate({"root": root}), model=model, train=TrainConfig(steps=7)
    )
    save_config(config, folder / "run" / RESOLVED_NAME)
    gaussians = row_of_balls()
    tensors = {f"gaussians.{name}": x.contiguous() for name, x in gaussians.tensors().items()}
    if moves:
        tensors |= {
            f"model.field.{name}": x
            for name, x in strip_roles(field_state(sliding_nodes())).items()
        }
        tensors["model.rows"] = torch.tensor(MOVING_ROWS)
        tensors["model.times"] = torch.tensor(TRAIN_TIMES, dtype=torch.float64)
    info = CheckpointInfo(7, 1.0, offset, "white", "classic")
    save_checkpoint(folder / "run", Checkpoint(info, tensors), 1.0)
    return folder / "run"


def moved_x(rows: tuple[int, ...], time: float) -> Tensor:
    """x of the balls ``rows`` of ``write_moving_run`` at ``time``."""
    x = row_of_balls().means[:, 0].clone()
    x[list(MOVING_ROWS)] += time - 0.5
    return x[list(rows)]
