"""From run to smaller run: the same bytes as with the stage in the configuration, and honest numbers."""

from __future__ import annotations

from pathlib import Path

import pytest
from moving_scene import write_moving_run
from tiny_fields import busy_config, write_tiny_capture

from dyngs.api.prune import compared, prune_run
from dyngs.api.train import train
from dyngs.config import PruneConfig
from dyngs.config.io import load_resolved
from dyngs.errors import DyngsError
from dyngs.evaluate.report import evaluate_run
from dyngs.runs.checkpoint import checkpoint_paths, load_run

pytestmark = pytest.mark.usefixtures("one_thread")
ASKED = ("prune.share=0.5", "prune.max_loss=100", "prune.steps=6", "prune.mask_times=3", "run.threads=1")


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    return train(busy_config(write_tiny_capture(folder / "capture"), folder / "run", "control_nodes"))


def test_it_is_the_stage_of_training_afterwards(run_dir: Path, tmp_path: Path) -> None:
    small = prune_run(run_dir, tmp_path / "small", ASKED)
    config = busy_config(load_resolved(run_dir).data.root, tmp_path / "whole", "control_nodes")
    stage = PruneConfig(share=0.5, max_loss=100, steps=6, mask_times=3)
    whole = train(config.model_copy(update={"prune": stage}))
    assert checkpoint_paths(small)[-1].read_bytes() == checkpoint_paths(whole)[-1].read_bytes()
    assert load_run(run_dir).step == 24, "the first run is as it was"
    assert (small / "log.jsonl").read_text().count("\n") >= 30


def test_a_compacted_run_can_be_compacted(run_dir: Path, tmp_path: Path) -> None:
    once = prune_run(run_dir, tmp_path / "once", ASKED)
    twice = prune_run(once, tmp_path / "twice", ("prune.share=0.5", "prune.max_loss=100", "prune.steps=2"))
    sizes = [len(load_run(folder).scene) for folder in (run_dir, once, twice)]
    assert sizes[0] > sizes[1] > sizes[2]
    assert load_run(twice).step == 32


def test_compared_numbers_are_those_of_eval(run_dir: Path, tmp_path: Path) -> None:
    small = prune_run(run_dir, tmp_path / "small", ASKED)
    costs = compared(run_dir, small, 1)
    for folder, cost in zip((run_dir, small), costs, strict=True):
        report = evaluate_run(folder, "test", threads=1)
        assert cost.num_gaussians == report.num_gaussians
        assert cost.psnr_test == pytest.approx(report.psnr, abs=0.5)  # eval does not clamp what it draws
        assert cost.megabytes == report.model_mb
        assert cost.fps > 0
    assert costs[1].num_gaussians < costs[0].num_gaussians


def test_an_interruption_at_the_start_leaves_nothing(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("dyngs.api.prune.save_config", interrupted)
        with pytest.raises(KeyboardInterrupt):
            prune_run(run_dir, tmp_path / "small", ASKED)
    assert not list(tmp_path.iterdir())
    assert checkpoint_paths(prune_run(run_dir, tmp_path / "small", ASKED))


def test_what_cannot_be_done_is_refused(tmp_path: Path) -> None:
    run_dir = write_moving_run(tmp_path)
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "file").write_text("mine")
    for out, overrides, message in (
        (taken, ["prune.share=0.5"], "exists already; give another --out"),
        (taken / "file", ["prune.share=0.5"], "exists already"),
        (run_dir, ["prune.share=0.5"], "exists already"),
        (tmp_path / "new", ["prune.share=1"], "prune.share"),
        (tmp_path / "new", ["prune.share=-0.1"], "prune.share"),
        (tmp_path / "new", ["prune.share=0"], "nothing to do"),
        (tmp_path / "new", ["prune.score=beauty"], "prune.score"),
    ):
        with pytest.raises(DyngsError, match=message):
            prune_run(run_dir, out, overrides)
    with pytest.raises(DyngsError, match="no checkpoints there"):
        prune_run(tmp_path / "nowhere", tmp_path / "new", ["prune.share=0.5"])
    assert not (tmp_path / "new").exists()
    assert (taken / "file").read_text() == "mine"
