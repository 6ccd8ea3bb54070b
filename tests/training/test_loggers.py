"""Progress images and loggers: files, calls of other programs, and the same trained bytes."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import dyngs
from dyngs.cli import main
from dyngs.config.io import load_config
from dyngs.core.errors import DyngsError
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.training.events import Event, ProgressImage
from dyngs.training.loggers import open_loggers

WANDB = """
calls = []
Image = lambda pixels: ("image", pixels.shape, str(pixels.dtype))
class Run:
    def log(self, values, step): calls.append((step, values))
    def finish(self): calls.append("finished")
def init(**options):
    if options["name"] == "refused": raise RuntimeError("log in first")
    calls.append(options)
    return Run()
"""
RERUN = """
calls = []
Scalars = lambda value: ("scalar", value)
Image = lambda pixels: ("image", pixels.shape)
class RecordingStream:
    def __init__(self, name): self.step = None
    def save(self, path): calls.append(path)
    def set_time(self, name, *, sequence): self.step = sequence
    def log(self, name, value): calls.append((self.step, name, value))
    def flush(self): calls.append("flushed")
"""


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Modules with the calls of wandb and rerun that are used, which record them."""
    folder = tmp_path / "programs"
    folder.mkdir()
    (folder / "wandb.py").write_text(WANDB)
    (folder / "rerun.py").write_text(RERUN)
    for name in ("wandb", "rerun"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(folder)
    yield
    for name in ("wandb", "rerun"):
        sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_static_capture(folder, StaticOptions(size=16, num_train=4, num_test=2, samples=1))
    return folder


def options(capture: Path, run: Path, *more: str) -> list[str]:
    keys = ["train.steps=6", "train.log_every=3", "init.num_random=60", "run.threads=1", *more]
    return [f"data.root={capture}", f"run.dir={run}", *keys]


def train(capture: Path, run: Path, *more: str, listeners: tuple[Any, ...] = ()) -> bytes:
    """Return the bytes of the last checkpoint."""
    config = load_config("static", options(capture, run, *more))
    dyngs.train(config, listeners=list(listeners))
    return sorted(run.glob("checkpoints/*"))[-1].read_bytes()


@pytest.mark.usefixtures("programs")
def test_images_and_scalars_reach_programs_and_change_nothing(
    capture: Path, tmp_path: Path
) -> None:
    events: list[Event] = []
    run = tmp_path / "run"
    more = ["train.loggers=[wandb, rerun]", "train.image_every=3", "train.eval_every=6"]
    seen = train(capture, run, *more, listeners=(events.append,))
    assert seen == train(capture, tmp_path / "plain", "train.eval_every=6")

    images = [event for event in events if isinstance(event, ProgressImage)]
    assert [(event.step, event.split) for event in images] == [(3, "test"), (6, "test")]
    assert sorted(file.name for file in (run / "progress").iterdir()) == [
        "step_0000003.png",
        "step_0000006.png",
    ]
    view = dyngs.read_capture(capture).splits["test"][0]
    stored = np.asarray(Image.open(run / "progress" / "step_0000006.png"))
    assert np.array_equal(stored, images[1].pixels)
    photo = np.asarray(Image.open(view.image_path)) / 255
    on_white = photo[..., :3] * photo[..., 3:] + 1 - photo[..., 3:]
    assert np.abs(stored[:, 16:] / 255 - on_white).max() < 0.01

    import rerun
    import wandb

    start, *calls, end = wandb.calls
    assert (start["project"], start["name"]) == ("dyngs", "run")
    assert start["config"]["train"]["steps"] == 6
    assert end == "finished"
    values: dict[tuple[int, str], Any] = {}
    for step, found in calls:
        values |= {(step, name): value for name, value in found.items()}
    assert values[3, "train/num_gaussians"] == 60
    assert values[6, "test/image"] == ("image", (16, 32, 3), "uint8")
    assert {(6, "test/psnr"), (6, "test/ssim"), (3, "train/loss"), (6, "train/psnr")} < set(values)
    assert rerun.calls[0] == run / "after_step_0.rrd"
    assert (6, "test/psnr", ("scalar", values[6, "test/psnr"])) in rerun.calls
    assert (3, "test/image", ("image", (16, 32, 3))) in rerun.calls
    assert rerun.calls[-1] == "flushed"


@pytest.mark.usefixtures("programs")
def test_a_program_that_cannot_start_is_named(capture: Path, tmp_path: Path) -> None:
    config = load_config("static", options(capture, tmp_path / "run", "train.loggers=[wandb]"))
    with pytest.raises(DyngsError, match=r"train\.loggers=wandb cannot be started: log in first"):
        open_loggers(config, tmp_path / "refused", 0)


def test_a_missing_program_is_refused_before_anything_is_written(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    monkeypatch.setattr("dyngs.training.loggers.find_spec", lambda name: None)
    run = tmp_path / "run"
    assert main(["train", "static", *options(capture, run, "train.loggers=[rerun]")]) == 2
    assert "pip install 'dyngs[rerun]'" in capsys.readouterr().err
    assert not run.exists()


def test_tensorboard_reads_what_is_written(capture: Path, tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="needs the extra tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    train(capture, tmp_path / "run", "train.loggers=[tensorboard]", "train.image_every=6")
    board = EventAccumulator(str(tmp_path / "run" / "tensorboard")).Reload()
    assert [x.step for x in board.Scalars("train/loss")] == [3, 6]
    (image,) = board.Images("test/image")
    assert (image.step, image.width, image.height) == (6, 32, 16)
