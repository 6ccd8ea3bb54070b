"""Whole runs on a tiny capture: loss, byte-identical repetition, interruption and resumption."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path

import pytest
import torch
from tiny_fields import ALL_KINDS, busy_config, write_tiny_capture
from torch import Tensor

from dyngs.api import train as train_module
from dyngs.api.train import train
from dyngs.cli import main
from dyngs.config import (
    Config,
    DataConfig,
    DefaultStrategy,
    McmcStrategy,
    RandomInit,
    RunConfig,
    TrainConfig,
)
from dyngs.config.io import (
    RESOLVED_NAME,
    load_resolved,
)
from dyngs.core.errors import DyngsError
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.deform.scene import DynamicScene
from dyngs.evaluate.report import evaluate_run
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.static_section import StaticModel
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.training import losses
from dyngs.training.clock import SaveTimer
from dyngs.training.events import Evaluated, Event, StepDone
from dyngs.training.trainer import StepReport, Trainer

# Everything happens within a few steps: changes each third step, a reset at step 5, new SH degrees.
BUSY = DefaultStrategy(
    start=1, stop=30_000, every=3, grad_threshold=1e-6, reset_every=5, max_gaussians=150
)
BUSY_MCMC = McmcStrategy(start=1, stop=30_000, every=3, max_gaussians=90, prune_opacity=0.45)

IN_TERMINAL = """
import fcntl, signal, sys, termios
from dyngs.__main__ import main
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup pytest: children inherit that it is ignored
fcntl.ioctl(0, termios.TIOCSCTTY, 0)  # signals of the terminal reach this process
sys.argv = ["dyngs", "train", sys.argv[1], f"run.dir={sys.argv[2]}"]
sys.exit(main())
"""


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_static_capture(folder, StaticOptions(size=16, num_train=4, num_test=1, samples=1))
    return folder


def _config(
    capture: Path,
    run_dir: Path,
    *,
    steps: int = 14,
    strategy: DefaultStrategy | McmcStrategy = BUSY,
    **changes: object,
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
    """The lines of training steps."""
    records = [json.loads(line) for line in (run_dir / "log.jsonl").read_text().splitlines()]
    return [record for record in records if "loss" in record]


def _stopped_and_resumed(config: Config, stop_at: int, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a run that was interrupted after step ``stop_at`` and then finished."""
    assert config.run.dir is not None
    with monkeypatch.context() as patch:
        _interrupt_after(stop_at, patch)
        with pytest.raises(KeyboardInterrupt, match="--resume"):
            train(config)
    assert load_run(config.run.dir).step == stop_at
    return train(load_resolved(config.run.dir), resume_from=config.run.dir)


def _interrupt_after(
    step: int, monkeypatch: pytest.MonkeyPatch, which: signal.Signals = signal.SIGINT
) -> None:
    """Send ``which`` to this process during ``step``, once."""
    real = Trainer.step

    def stepping(trainer: Trainer) -> StepReport:
        if trainer.done + 1 == step:
            signal.raise_signal(which)
        return real(trainer)

    monkeypatch.setattr(Trainer, "step", stepping)


def test_a_run_learns_and_leaves_its_folder(capture: Path, tmp_path: Path) -> None:
    config = _config(
        capture, tmp_path / "run", steps=60, strategy=DefaultStrategy(max_gaussians=1000)
    )
    # a loss whose weights do not change
    of_images = config.train.model_copy(update={"alpha_weight": 0.0})
    config = config.model_copy(update={"train": of_images})
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


@pytest.mark.parametrize("strategy", [BUSY, BUSY_MCMC], ids=["default", "mcmc"])
def test_the_seed_decides_every_byte_and_threads_none(
    capture: Path, tmp_path: Path, strategy: DefaultStrategy | McmcStrategy
) -> None:
    results = {}
    for name, seed, threads in (
        ("a", 1, 1),
        ("again", 1, 1),
        ("two threads", 1, 2),
        ("other seed", 2, 1),
    ):
        run = RunConfig(dir=tmp_path / name, seed=seed, threads=threads)
        results[name] = _final_bytes(train(_config(capture, tmp_path, strategy=strategy, run=run)))
    assert results["a"] == results["again"] == results["two threads"]
    assert results["a"] != results["other seed"]
    counts = {record["num_gaussians"] for record in _log(tmp_path / "a")}
    assert len(counts) > 2, "the set of Gaussians must change, or this test shows little"


@pytest.mark.parametrize("stop_at", [2, 8])
@pytest.mark.parametrize("kind", ["default", "mcmc", "filtered", "absgrad"])
def test_resumed_equals_uninterrupted(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, stop_at: int
) -> None:
    strategy = {"mcmc": BUSY_MCMC, "absgrad": BUSY.model_copy(update={"absgrad": True})}.get(
        kind, BUSY
    )
    changes = {
        "model": StaticModel(sh_degree=2, filter_3d=kind == "filtered"),
        "data": DataConfig(root=capture, background="random"),
    }
    whole = train(_config(capture, tmp_path / "whole", strategy=strategy, **changes))
    config = _config(capture, tmp_path / "parts", strategy=strategy, **changes)
    resumed = _stopped_and_resumed(config, stop_at, monkeypatch)
    assert _final_bytes(resumed) == _final_bytes(whole)
    same = ("step", "loss", "psnr", "num_gaussians")
    assert [[r[k] for k in same] for r in _log(resumed)] == [
        [r[k] for k in same] for r in _log(whole)
    ]


def test_sigterm_saves_too(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _interrupt_after(3, monkeypatch, signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt, match="stopped after step 3"):
        train(_config(capture, tmp_path / "run"))
    assert load_run(tmp_path / "run").step == 3


@pytest.fixture
def interrupted(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run that was stopped; its capture is a copy."""
    shutil.copytree(capture, tmp_path / "capture")
    with monkeypatch.context() as patch:
        _interrupt_after(3, patch)
        with pytest.raises(KeyboardInterrupt):
            train(_config(tmp_path / "capture", tmp_path / "run", steps=6))
    return tmp_path / "run"


def test_a_resumed_run_refuses_another_capture(
    interrupted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Refuse a different capture when resuming; a copy of the capture resumes to identical
    bytes."""
    other = tmp_path / "other"
    copied = tmp_path / "copied"
    write_static_capture(other, StaticOptions(size=24, num_train=4, num_test=1, samples=1))
    before = (interrupted / RESOLVED_NAME).read_text()
    assert main(["train", "--resume", str(interrupted), f"data.root={other}"]) == 2
    assert "other sizes, times or cameras of train/r_000" in capsys.readouterr().err
    assert (interrupted / RESOLVED_NAME).read_text() == before
    (tmp_path / "capture").rename(copied)
    assert main(["train", "--resume", str(interrupted), f"data.root={copied}"]) == 0
    assert "warning" not in capsys.readouterr().err
    assert _final_bytes(interrupted) == _final_bytes(
        train(_config(copied, tmp_path / "whole", steps=6))
    )
    shutil.copytree(other, copied, dirs_exist_ok=True)
    assert main(["train", "--resume", str(interrupted), "train.steps=8"]) == 2
    assert "not the capture that the run was trained on" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        (
            "  kind: static\n",
            "  kind: dynamic\n",
            "model.kind=static, but config.yaml has model.kind=dynamic",
        ),
        (
            "  sh_degree: 2\n",
            "  sh_degree: 1\n",
            "model.sh_degree=2, but config.yaml has model.sh_degree=1",
        ),
        (
            "  refine: never\n",
            "  refine: always\n",
            "camera.refine=never, but config.yaml has camera.refine=always",
        ),
        ("  exposure: never\n", "  exposure: always\n", "train.exposure=never, but config.yaml"),
    ],
)
def test_an_edited_configuration_that_contradicts_the_checkpoint_is_refused(
    before: str, after: str, said: str, interrupted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = interrupted / RESOLVED_NAME
    text = file.read_text()
    assert text.count(before) == 1
    file.write_text(text.replace(before, after))
    for words in (["train", "--resume", str(interrupted)], ["eval", str(interrupted)]):
        assert main(words) == 2
        assert said in capsys.readouterr().err


def test_a_folder_that_is_removed_loses_nothing_but_its_log(capture: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    still = tmp_path / "still"
    train(_config(capture, still, steps=12))

    def remove(event: Event) -> None:
        if isinstance(event, StepDone) and event.step == 5:
            shutil.rmtree(run)

    assert train(_config(capture, run, steps=12), listeners=[remove]) == run
    assert _final_bytes(run) == _final_bytes(still)
    assert train(load_resolved(run), resume_from=run) == run


def test_bad_input_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(DyngsError):
        train(_config(tmp_path / "nothing here", tmp_path / "run"))
    with pytest.raises(DyngsError, match="no checkpoints"):
        train(_config(tmp_path, tmp_path / "run"), resume_from=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_loss_that_is_not_finite_stops_the_run(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = losses.l1_ssim_loss
    calls = []

    def failing(rendered: Tensor, target: Tensor, weight: float, mask: Tensor | None) -> Tensor:
        calls.append(0)
        return real(rendered, target, weight, mask) * (float("nan") if len(calls) == 6 else 1.0)

    monkeypatch.setattr(losses, "l1_ssim_loss", failing)
    config = _config(capture, tmp_path / "run", train=TrainConfig(steps=14, save_every=4))
    with pytest.raises(DyngsError, match=r"step 6, view .*'image' is nan.*step_0000004"):
        train(config)
    assert load_run(tmp_path / "run").step == 4


def test_checkpoints_and_scores_come_when_asked(capture: Path, tmp_path: Path) -> None:
    options = TrainConfig(steps=9, save_every=3, eval_every=6, log_every=100)
    folder = train(_config(capture, tmp_path / "run", train=options))
    assert [path.stem for path in checkpoint_paths(folder)] == ["step_0000006", "step_0000009"]
    lines = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    assert [(line["step"], "ssim" in line) for line in lines] == [(6, True), (9, False), (9, True)]
    assert json.loads((folder / "metrics.json").read_text())["num_views"] == 1


def test_held_out_psnr_leaves_the_result_as_it_is(capture: Path, tmp_path: Path) -> None:
    events = list[Event]()
    folders = []
    for scored in (True, False):
        options = TrainConfig(steps=9, eval_psnr=scored)
        config = _config(capture, tmp_path / str(scored), train=options)
        folders.append(train(config, listeners=[events.append]))
    (scores,) = (event for event in events if isinstance(event, Evaluated))
    assert (scores.step, scores.num_views, scores.ssim) == (9, 1, None)
    assert scores.psnr == pytest.approx(evaluate_run(folders[0]).psnr, abs=1e-6)
    first, second = (checkpoint_paths(folder)[-1].read_bytes() for folder in folders)
    assert first == second


@pytest.fixture
def saves_each_step(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The time between checkpoints is over after each step; returns the steps of all that are
    written."""
    saved = list[int]()
    real = train_module.save_checkpoint

    def noted(folder: Path, checkpoint: Checkpoint, seconds: float) -> Path:
        saved.append(checkpoint.info.step)
        return real(folder, checkpoint, seconds)

    monkeypatch.setattr(train_module, "save_checkpoint", noted)
    monkeypatch.setattr(SaveTimer, "is_due", lambda timer, now: timer._minutes > 0)
    return saved


def _saved_often(config: Config, minutes: float = 5.0) -> Config:
    return config.model_copy(
        update={"train": config.train.model_copy(update={"save_minutes": minutes})}
    )


@pytest.mark.parametrize("strategy", [BUSY, BUSY_MCMC], ids=["default", "mcmc"])
def test_saving_changes_no_byte(
    capture: Path,
    tmp_path: Path,
    strategy: DefaultStrategy | McmcStrategy,
    saves_each_step: list[int],
) -> None:
    plain = train(_saved_often(_config(capture, tmp_path / "plain", strategy=strategy), 0))
    assert saves_each_step == [14]
    often = train(_config(capture, tmp_path / "often", strategy=strategy))
    assert saves_each_step[1:] == list(range(1, 15))
    assert [path.stem for path in checkpoint_paths(often)] == ["step_0000013", "step_0000014"]
    assert _final_bytes(plain) == _final_bytes(often)


# --- scenes that move
# -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def moving_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_capture(tmp_path_factory.mktemp("moving") / "capture")


@pytest.fixture(scope="module", params=ALL_KINDS)
def whole_run(
    request: pytest.FixtureRequest, moving_capture: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """An uninterrupted run of each kind of field."""
    return train(
        busy_config(moving_capture, tmp_path_factory.mktemp(request.param) / "run", request.param)
    )


def _kind_of(run_dir: Path) -> str:
    return run_dir.parent.name.rstrip("0123456789")


@pytest.mark.parametrize(
    ("whole_run", "stop_at"),
    [
        *((kind, 11) for kind in ALL_KINDS),
        *((kind, stop) for kind in ("control_nodes", "mlp") for stop in (2, 8, 18)),
    ],
    indirect=["whole_run"],
    scope="module",
)
def test_a_resumed_moving_run_equals_an_uninterrupted_one(
    whole_run: Path,
    moving_capture: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    stop_at: int,
) -> None:
    config = busy_config(moving_capture, tmp_path / "parts", _kind_of(whole_run))
    resumed = _stopped_and_resumed(config, stop_at, monkeypatch)
    assert _final_bytes(resumed) == _final_bytes(whole_run)
    same = ("step", "loss", "psnr", "num_gaussians", "num_moving")
    assert [[r[k] for k in same] for r in _log(resumed)] == [
        [r[k] for k in same] for r in _log(whole_run)
    ]


def _spoil_in_step(step: int, monkeypatch: pytest.MonkeyPatch, value: float) -> None:
    """Fill all that the field has learned with ``value`` before ``step``."""
    real = Trainer.step

    def stepping(trainer: Trainer) -> StepReport:
        scene = trainer.model.scene
        if trainer.done + 1 == step and isinstance(scene, DynamicScene) and scene.field is not None:
            for x in scene.field.parameters.values().values():
                x.fill_(value)
        return real(trainer)

    monkeypatch.setattr(Trainer, "step", stepping)
