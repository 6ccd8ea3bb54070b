"""Runs in several processes: the bytes of one process, one writer, one line where one fails."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import several_processes as do
import torch
from several_processes import run_in
from tiny_fields import busy_config

from dyngs.api.train import train
from dyngs.config import Config, DataConfig, DefaultStrategy, RandomInit, RunConfig, TrainConfig
from dyngs.core.errors import DyngsError
from dyngs.human.keys import HumanModel
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture
from dyngs.models.static_section import StaticModel
from dyngs.runs.checkpoint import checkpoint_paths, latest_checkpoint, load_checkpoint
from dyngs.runs.folder import LOG_NAME
from dyngs.training.processes import Processes

BUSY = DefaultStrategy(
    start=1, stop=30_000, every=3, grad_threshold=1e-6, reset_every=5, max_gaussians=150
)


def _still(capture: Path, run: Path, **options: object) -> Config:
    return Config(
        data=DataConfig(root=capture, background="random"),
        model=StaticModel(sh_degree=1),
        init=RandomInit(num_random=60),
        strategy=BUSY,
        train=TrainConfig.model_validate(
            {"steps": 12, "log_every": 1, "remove_floaters": False, **options}
        ),
        run=RunConfig(dir=run, threads=1),
    )


def _moving(capture: Path, run: Path, batch: int) -> Config:
    config = busy_config(capture, run, "control_nodes", pilot_runs=False)
    return config.model_copy(update={"train": TrainConfig(steps=24, log_every=1, batch_size=batch)})


def _person(capture: Path, run: Path, batch: int) -> Config:
    return Config(
        data=DataConfig(root=capture),
        model=HumanModel(resolution=16, sh_degree=0, fit=False),
        strategy=BUSY.model_copy(update={"grow": False, "prune_opacity": 0.09}),
        train=TrainConfig(steps=8, batch_size=batch),
        run=RunConfig(dir=run, threads=1),
    )


def _require_same_bytes(one: Path, other: Path) -> None:
    first, second = (checkpoint_paths(run)[-1] for run in (one, other))
    tensors = [load_checkpoint(path).tensors for path in (first, second)]
    assert [name for name, x in tensors[0].items() if not torch.equal(x, tensors[1][name])] == []
    assert first.read_bytes() == second.read_bytes()


@pytest.fixture(scope="module")
def small_person(tmp_path_factory: pytest.TempPathFactory) -> Path:
    options = HumanOptions(
        size=32, num_frames=3, num_pose_frames=1, num_cameras=2, num_test=1, samples=1
    )
    return write_human_capture(tmp_path_factory.mktemp("person"), options)


def test_two_processes_end_with_the_bytes_of_one(
    moving: Path, still: Path, small_person: Path, tmp_path: Path
) -> None:
    def configs(folder: str) -> list[Config]:
        return [
            _still(still, tmp_path / folder / "still", batch_size=2),
            _moving(moving, tmp_path / folder / "moving", 2),
            _person(small_person, tmp_path / folder / "person", 2),
        ]

    codes, said = run_in(2, do.trained, tmp_path, configs("two"))
    assert codes == [0, 0], said
    assert said[1] == ""
    counts = set[int]()
    for config in configs("one"):
        train(config)
        assert config.run.dir is not None
        _require_same_bytes(config.run.dir, tmp_path / "two" / config.run.dir.name)
        log = (config.run.dir / LOG_NAME).read_text(encoding="utf-8").splitlines()
        counts |= {json.loads(line).get("num_gaussians") for line in log}
    assert len(counts) > 3, "the set of Gaussians changes"


def test_a_run_goes_on_in_another_number_of_processes(still: Path, tmp_path: Path) -> None:
    whole, parted = (
        _still(still, tmp_path / name, batch_size=2, save_every=5) for name in ("whole", "parted")
    )
    train(whole)
    train(parted)
    for path in checkpoint_paths(tmp_path / "parted")[-1:]:
        path.unlink()
    assert latest_checkpoint(tmp_path / "parted").info.step < 12
    codes, said = run_in(2, do.resumed, tmp_path, tmp_path / "parted")
    assert codes == [0, 0], said
    _require_same_bytes(tmp_path / "whole", tmp_path / "parted")


@pytest.mark.parametrize(
    ("fails", "line"),
    [
        ("step", "dyngs: error: image 3 is damaged"),
        ("weights", "after step 5: Gaussians of process 1 differ from those of process 0"),
        ("death", "connection lost, another process was killed"),
    ],
)
def test_a_failure_of_one_process_ends_all_with_one_line(
    fails: str, line: str, still: Path, tmp_path: Path
) -> None:
    codes, said = run_in(2, do.trained, tmp_path, [_still(still, tmp_path / "run")], fails)
    assert codes == [2, 9 if fails == "death" else 2]
    errors = [
        x for text in said for x in text.splitlines() if not x.startswith(("memory:", "step "))
    ]
    assert len(errors) == 1
    assert line in errors[0]


def test_a_signal_to_any_process_ends_the_run_which_can_go_on(still: Path, tmp_path: Path) -> None:
    """SIGTERM reaches the last process during step 4, and rank 0 saves a checkpoint."""
    run = tmp_path / "run"
    codes, said = run_in(2, do.trained, tmp_path, [_still(still, run, steps=400)], "SIGTERM")
    assert codes == [130, 130], said
    assert said[1] == ""
    step = latest_checkpoint(run).info.step
    assert 4 <= step < 400
    assert (
        f"dyngs: interrupted: stopped after step {step}; go on with: dyngs train --resume"
        in said[0]
    )


def test_single_process_features_are_refused(still: Path, tmp_path: Path) -> None:
    two = Processes(0, 2)
    with pytest.raises(
        DyngsError, match="minutes=1: is measured with one process; leave it out, or start without"
    ):
        train(_still(still, tmp_path / "run", minutes=1), processes=two)
    with pytest.raises(
        DyngsError, match=r"batch_size=2: train[.]robust=always needs one image per step"
    ):
        train(_still(still, tmp_path / "run", robust="always"), processes=two)
    with pytest.raises(
        DyngsError, match="batch_size=5: must be a multiple of the number of processes, 2"
    ):
        train(_still(still, tmp_path / "run", batch_size=5), processes=two)
