"""Trials between two scenes: the better one stays, and nothing else has happened."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_fields import busy_config, write_tiny_capture

from dyngs.build import assemble
from dyngs.config import Config, ControlNodesField
from dyngs.gaussians.scene import Variant
from dyngs.training import trial
from dyngs.training.processes import Processes
from dyngs.training.state import Checkpoint, CheckpointInfo
from dyngs.training.trainer import Trainer
from dyngs.training.trial import decide

MEAN_PSNR = trial._mean_psnr


class Runner:
    """As a trainer whose scene is one number in place, whose images are as good as it is, and who learns 1 a step."""

    def __init__(self) -> None:
        self.scene, self.done, self.bad_gradients = torch.tensor([20.0]), 7, 3
        self.seen: list[int] = []
        self.processes = Processes()

    def checkpoint(self) -> Checkpoint:
        info = CheckpointInfo(self.done, 1.0, (0.0, 0.0, 0.0), "white", "classic")
        return Checkpoint(info, {"scene": self.scene})

    def restore(self, checkpoint: Checkpoint) -> None:
        self.scene, self.done = checkpoint.tensors["scene"].clone(), checkpoint.info.step

    def step(self) -> Any:
        self.done += 1
        self.seen.append(self.done)
        self.bad_gradients += 1
        self.scene += 1.0
        return SimpleNamespace(psnr=float(self.scene))


@pytest.mark.parametrize(("other", "left", "word"), [(21.0, 21.0, " taken"), (19.0, 20.0, " not taken")])
def test_the_better_scene_stays_as_it_was_before_the_trial(other: float, left: float, word: str) -> None:
    runner = Runner()
    line = decide(runner, Variant("stripes", torch.tensor([other]), 4))  # type: ignore[arg-type]
    assert runner.scene.tolist() == [left]
    assert (runner.done, runner.bad_gradients) == (7, 3)
    assert runner.seen == [8, 9, 10, 11] * 2, "both are trained on the same steps"
    assert line.startswith(f"stripes{word}: ")
    shown = float(line.split(": ")[1].split(" dB")[0])
    assert shown == pytest.approx(other + 3.5, abs=0.05), "the last half of the steps counts"


def grouping_config(capture: Path, groups: str) -> Config:
    """A run of 24 steps in which nodes may form groups after step 15."""
    field = ControlNodesField(nodes=20, pieces=3, lr_means=1e-2, rigid_groups=groups)  # type: ignore[arg-type]
    return busy_config(capture, capture / "run", "control_nodes", deform=field, freeze_below_px=0.0)


def trained(config: Config, steps: int, wins: bool, monkeypatch: pytest.MonkeyPatch) -> tuple[Trainer, list[str]]:
    """A trainer after ``steps``, with the trial's outcome given, and the lines that were said."""
    scores = iter([0.0, 1.0 if wins else -1.0])

    def scored(*arguments: Any) -> float:
        MEAN_PSNR(*arguments)
        return next(scores)

    monkeypatch.setattr(trial, "_mean_psnr", scored)
    trainer = assemble(config)
    return trainer, [text for _ in range(steps) if (text := trainer.step().finding) is not None]


def test_a_lost_trial_leaves_no_trace_and_a_won_one_goes_on_from_a_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = write_tiny_capture(tmp_path / "capture")
    never, _ = trained(grouping_config(capture, "never"), 19, False, monkeypatch)
    lost, said = trained(grouping_config(capture, "auto"), 19, False, monkeypatch)
    assert "not taken" in said[-1]
    expected, found = never.checkpoint().tensors, lost.checkpoint().tensors
    assert expected.keys() == found.keys()
    assert all(torch.equal(x, found[name]) for name, x in expected.items())
    won, said = trained(grouping_config(capture, "auto"), 17, True, monkeypatch)
    assert "rigid groups of control nodes taken" in said[-1]
    middle = trial._copied(won.checkpoint())
    assert "model.field.learned.group_quats" in middle.tensors
    resumed = assemble(won.config, restored=True)
    resumed.restore(middle)
    for trainer in (won, resumed):
        for _ in range(4):  # the set of Gaussians changes after step 18
            trainer.step()
    expected, found = won.checkpoint().tensors, resumed.checkpoint().tensors
    assert expected.keys() == found.keys()
    assert all(torch.equal(x, found[name]) for name, x in expected.items())
