"""From run to smaller run: the same bytes as with the stage in the configuration, and a promise
that is kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from moving_scene import write_moving_run
from pretend_gpu import GPU, pretend_gpu
from tiny_fields import busy_config, write_tiny_capture

from dyngs.api.prune import export_folder, prune_run, prune_to_loss
from dyngs.api.train import train
from dyngs.compress.search import held_out_indices
from dyngs.compress.stage import mean_psnr
from dyngs.config import PruneConfig
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError
from dyngs.evaluate.report import compare_runs
from dyngs.runs.checkpoint import SCENE_FILE, checkpoint_paths, latest_checkpoint, load_run
from dyngs.training.new_trainer import build_trainer

pytestmark = pytest.mark.usefixtures("one_thread")
ASKED = (
    "prune.fraction=0.5",
    "prune.steps=6",
    "prune.mask_times=3",
    "prune.mask_between=false",
    "run.threads=1",
)
BRIEFLY = ("prune.steps=4", "run.threads=1")


def silent(text: str) -> None:
    """Discard a progress message."""


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    return train(
        busy_config(write_tiny_capture(folder / "capture"), folder / "run", "control_nodes")
    )


@pytest.fixture
def few_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search tries one value of each kind of limit."""
    few = {
        "LEFT_GAUSSIANS": (0.5,),
        "CUT_OFFS": (0.02,),
        "HARMONIC_LOSSES": (0.03,),
    }
    for name, candidates in few.items():
        monkeypatch.setattr(f"dyngs.compress.search.{name}", candidates)


def test_it_is_the_stage_of_training_afterwards(run_dir: Path, tmp_path: Path) -> None:
    small = prune_run(run_dir, tmp_path / "small", ASKED)
    config = busy_config(load_resolved(run_dir).data.root, tmp_path / "whole", "control_nodes")
    stage = PruneConfig(fraction=0.5, steps=6, mask_times=3, mask_between=False)
    whole = train(config.model_copy(update={"prune": stage}))
    assert checkpoint_paths(small)[-1].read_bytes() == checkpoint_paths(whole)[-1].read_bytes()
    assert load_run(run_dir).step == 24, "the first run is as it was"
    assert (small / "log.jsonl").read_text().count("\n") >= 30
    assert len(load_run(export_folder(small)).scene) == len(load_run(small).scene)


@pytest.mark.usefixtures("few_candidates")
def test_a_pruned_run_can_be_pruned(run_dir: Path, tmp_path: Path) -> None:
    once = prune_run(run_dir, tmp_path / "once", ASKED)
    twice = prune_run(once, tmp_path / "twice", ("prune.fraction=0.5", "prune.steps=2"))
    thrice = tmp_path / "thrice"
    prune_to_loss(twice, thrice, 50.0, BRIEFLY, silent)
    sizes = [len(load_run(folder).scene) for folder in (run_dir, once, twice, thrice)]
    assert sizes[0] > sizes[1] > sizes[2] > sizes[3]
    assert load_run(twice).step == 32
    assert load_run(thrice).step == 36


@pytest.mark.usefixtures("few_candidates")
def test_on_a_gpu_it_is_the_same(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The search, of few candidates, its file, and the comparison with the run before."""
    briefly = ("prune.steps=1", "run.threads=1")
    expected = prune_to_loss(run_dir, tmp_path / "here", 3.0, briefly, silent)
    here = compare_runs([run_dir, export_folder(tmp_path / "here")], 1)
    monkeypatch.setattr("dyngs.training.new_trainer.select_device", lambda _: GPU)
    with pretend_gpu():
        found = prune_to_loss(run_dir, tmp_path / "there", 3.0, briefly, silent)
        there = compare_runs([run_dir, export_folder(tmp_path / "there")], 1, GPU)
    assert found == expected
    files = [export_folder(tmp_path / name) / SCENE_FILE for name in ("there", "here")]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert [replace(x, fps=1) for x in there] == [replace(x, fps=1) for x in here]


def test_the_promise_is_kept_by_the_file(run_dir: Path, tmp_path: Path) -> None:
    """On views that fine-tuning has not seen; and it is the same each time."""
    told: list[str] = []
    folder = tmp_path / "a"
    first, again = (
        prune_to_loss(run_dir, tmp_path / name, 1.0, BRIEFLY, told.append) for name in ("a", "b")
    )
    assert first == again
    assert told[: len(told) // 2] == told[len(told) // 2 :]
    for path in (checkpoint_paths(folder)[-1], export_folder(folder) / SCENE_FILE):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(folder)).read_bytes()
    assert first.before - first.after <= 1.0
    config = load_resolved(folder)
    trainer = build_trainer(config, restored=True)
    trainer.restore(latest_checkpoint(folder))
    shown = [trainer.images[i] for i in held_out_indices(len(trainer.images))]
    assert mean_psnr(trainer, load_run(export_folder(folder)).scene, shown) == pytest.approx(
        first.after, abs=1e-4
    )
    before, after = compare_runs([run_dir, export_folder(folder)], 1)
    assert after.num_gaussians < before.num_gaussians
    assert after.stored is not None
    assert after.stored < before.megabytes


def test_what_cannot_be_done_is_refused(tmp_path: Path) -> None:
    run_dir = write_moving_run(tmp_path)
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "file").write_text("mine")
    for out, overrides, message in (
        (taken, ["prune.fraction=0.5"], "exists already; use another --out"),
        (taken / "file", ["prune.fraction=0.5"], "exists already"),
        (run_dir, ["prune.fraction=0.5"], "exists already"),
        (tmp_path / "new", ["prune.fraction=1"], "prune.fraction"),
        (tmp_path / "new", ["prune.fraction=-0.1"], "prune.fraction"),
        (tmp_path / "new", ["prune.fraction=0"], "nothing to do"),
        (tmp_path / "new", ["prune.score=beauty"], "prune.score"),
        (
            tmp_path / "new",
            ["prune.fraction=0.5", "prune.max_loss=1"],
            "unknown key 'prune.max_loss'",
        ),
    ):
        with pytest.raises(DyngsError, match=message):
            prune_run(run_dir, out, overrides)
    with pytest.raises(DyngsError, match="no checkpoints found"):
        prune_run(tmp_path / "nowhere", tmp_path / "new", ["prune.fraction=0.5"])
    for out, overrides, message in (
        (taken, [], "exists already; use another --out"),
        (tmp_path / "new", ["prune.fraction=0.5"], "are chosen with --prune R"),
        (tmp_path / "new", ["model.alpha_min=0.1"], "losses are counted from RUN as it is"),
    ):
        with pytest.raises(DyngsError, match=message):
            prune_to_loss(run_dir, out, 0.2, overrides)
    assert not (tmp_path / "new").exists()
    assert (taken / "file").read_text() == "mine"
