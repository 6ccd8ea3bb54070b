"""Whole runs on a tiny capture: they learn, they repeat to the byte, they stop and go on as if nothing had happened."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest
import torch
from torch import Tensor

from dyngs.config import (
    Config,
    DataConfig,
    DefaultStrategy,
    McmcStrategy,
    RandomInit,
    RunConfig,
    StaticModel,
    TrainConfig,
)
from dyngs.config_io import load_resolved
from dyngs.data.synthetic import StillOptions, write_still_capture
from dyngs.errors import DyngsError
from dyngs.train.checkpoint import checkpoint_paths, load_run
from dyngs.train.step import StepReport, Trainer
from dyngs.train.trainer import train

# Everything happens within a few steps: changes each third step, a reset at step 5, new SH degrees.
BUSY = DefaultStrategy(start=1, stop=30_000, every=3, grad_threshold=1e-6, reset_every=5, max_gaussians=150)
BUSY_MCMC = McmcStrategy(start=1, stop=30_000, every=3, max_gaussians=90, min_opacity=0.45)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_still_capture(folder, StillOptions(size=16, num_train=4, num_test=1, samples=1))
    return folder


def _config(
    capture: Path, run_dir: Path, *, steps: int = 14, strategy: DefaultStrategy | McmcStrategy = BUSY, **changes: object
) -> Config:
    config = Config(
        data=DataConfig(root=capture),
        model=StaticModel(sh_degree=2),
        init=RandomInit(num_random=60),
        strategy=strategy,
        train=TrainConfig(steps=steps, log_every=1),
        run=RunConfig(dir=run_dir, threads=1),
    )
    return config.model_copy(update=changes)


def _final_bytes(run_dir: Path) -> bytes:
    return checkpoint_paths(run_dir)[-1].read_bytes()


def _log(run_dir: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (run_dir / "log.jsonl").read_text().splitlines()]


def _interrupt_after(step: int, monkeypatch: pytest.MonkeyPatch, which: signal.Signals = signal.SIGINT) -> None:
    """Send ``which`` to this process during ``step``, once."""
    real = Trainer.step

    def stepping(trainer: Trainer) -> StepReport:
        if trainer.done + 1 == step:
            signal.raise_signal(which)
        return real(trainer)

    monkeypatch.setattr(Trainer, "step", stepping)


def test_a_run_learns_and_leaves_its_folder(capture: Path, tmp_path: Path) -> None:
    config = _config(capture, tmp_path / "run", steps=60, strategy=DefaultStrategy())
    folder = train(config)
    assert folder == tmp_path / "run"
    assert load_resolved(folder) == config
    run = load_run(folder)
    assert run.step == 60
    assert run.seconds_train > 0
    log = _log(folder)
    assert [record["step"] for record in log] == list(range(1, 61))
    losses = torch.tensor([record["loss"] for record in log])
    assert losses[-8:].mean() < 0.6 * losses[:8].mean()


def test_the_default_folder_has_the_name_of_the_run(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = _config(capture, tmp_path, steps=1, run=RunConfig(name="pond", threads=1))
    assert train(config) == Path("runs/pond")
    assert checkpoint_paths(tmp_path / "runs" / "pond")


@pytest.mark.parametrize("strategy", [BUSY, BUSY_MCMC], ids=["default", "mcmc"])
def test_the_seed_decides_every_byte_and_threads_none(
    capture: Path, tmp_path: Path, strategy: DefaultStrategy | McmcStrategy
) -> None:
    results = {}
    for name, seed, threads in (("a", 1, 1), ("again", 1, 1), ("two threads", 1, 2), ("other seed", 2, 1)):
        run = RunConfig(dir=tmp_path / name, seed=seed, threads=threads)
        results[name] = _final_bytes(train(_config(capture, tmp_path, strategy=strategy, run=run)))
    assert results["a"] == results["again"] == results["two threads"]
    assert results["a"] != results["other seed"]
    counts = {record["num_gaussians"] for record in _log(tmp_path / "a")}
    assert len(counts) > 2, "the set of Gaussians must change, or this test shows little"


def test_threads_decide_nothing_above_the_grain_of_torch(capture: Path, tmp_path: Path) -> None:
    """torch shares work among threads from 32,768 elements on; some of its functions then round otherwise."""
    results = []
    for threads in (1, 2):
        config = _config(
            capture,
            tmp_path,
            steps=7,
            strategy=BUSY.model_copy(update={"max_gaussians": 150_000}),
            model=StaticModel(sh_degree=1, filter_3d=True),
            init=RandomInit(num_random=100_003),
            run=RunConfig(dir=tmp_path / str(threads), threads=threads),
        )
        results.append(_final_bytes(train(config)))
    assert results[0] == results[1]


@pytest.mark.parametrize("stop_at", [2, 8])
@pytest.mark.parametrize("kind", ["default", "mcmc", "filtered", "absgrad"])
def test_resumed_equals_uninterrupted(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, stop_at: int
) -> None:
    strategy = {"mcmc": BUSY_MCMC, "absgrad": BUSY.model_copy(update={"absgrad": True})}.get(kind, BUSY)
    changes = {
        "model": StaticModel(sh_degree=2, filter_3d=kind == "filtered"),
        "data": DataConfig(root=capture, background="random"),
    }
    whole = train(_config(capture, tmp_path / "whole", strategy=strategy, **changes))
    config = _config(capture, tmp_path / "parts", strategy=strategy, **changes)
    with monkeypatch.context() as patch:
        _interrupt_after(stop_at, patch)
        with pytest.raises(KeyboardInterrupt, match="--resume"):
            train(config)
    assert load_run(tmp_path / "parts").step == stop_at
    resumed = train(load_resolved(tmp_path / "parts"), resume_from=tmp_path / "parts")
    assert _final_bytes(resumed) == _final_bytes(whole)
    same = ("step", "loss", "psnr", "num_gaussians")
    assert [[r[k] for k in same] for r in _log(resumed)] == [[r[k] for k in same] for r in _log(whole)]


def test_sigterm_saves_too(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _interrupt_after(3, monkeypatch, signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt, match="stopped after step 3"):
        train(_config(capture, tmp_path / "run"))
    assert load_run(tmp_path / "run").step == 3


def test_time_adds_up_over_resumes(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_dir = tmp_path / "run"
    with monkeypatch.context() as patch:
        _interrupt_after(3, patch)
        with pytest.raises(KeyboardInterrupt):
            train(_config(capture, run_dir))
    before = load_run(run_dir).seconds_train
    (run_dir / "timing.json").write_text(json.dumps({"seconds_train": {"3": before + 1000}}))
    train(load_resolved(run_dir), resume_from=run_dir)
    assert 1000 + before < load_run(run_dir).seconds_train < 1060 + before


def test_a_run_is_never_overwritten(capture: Path, tmp_path: Path) -> None:
    config = _config(capture, tmp_path / "run", steps=2)
    train(config)
    before = _final_bytes(tmp_path / "run")
    with pytest.raises(DyngsError, match=r"already holds a run.*--resume"):
        train(config)
    assert train(config, resume_from=tmp_path / "run") == tmp_path / "run"  # finished: nothing to do
    assert _final_bytes(tmp_path / "run") == before


def test_bad_input_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(DyngsError):
        train(_config(tmp_path / "nothing here", tmp_path / "run"))
    with pytest.raises(DyngsError, match="no checkpoints"):
        train(_config(tmp_path, tmp_path / "run"), resume_from=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_loss_that_is_not_finite_stops_the_run(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dyngs.train import step

    real, calls = step.l1_ssim_loss, []

    def failing(rendered: Tensor, target: Tensor, weight: float, mask: Tensor | None) -> Tensor:
        calls.append(0)
        return real(rendered, target, weight, mask) * (float("nan") if len(calls) == 6 else 1.0)

    monkeypatch.setattr(step, "l1_ssim_loss", failing)
    config = _config(capture, tmp_path / "run", train=TrainConfig(steps=14, save_every=4))
    with pytest.raises(DyngsError, match=r"step 6, view .*'picture' is nan.*step_0000004"):
        train(config)
    assert load_run(tmp_path / "run").step == 4


def test_checkpoints_and_scores_come_when_asked(capture: Path, tmp_path: Path) -> None:
    options = TrainConfig(steps=9, save_every=3, eval_every=6, log_every=100)
    folder = train(_config(capture, tmp_path / "run", train=options))
    assert [path.stem for path in checkpoint_paths(folder)] == ["step_0000006", "step_0000009"]
    assert [(record["step"], "split" in record) for record in _log(folder)] == [(6, True), (9, False)]
    assert json.loads((folder / "metrics.json").read_text())["num_views"] == 1
