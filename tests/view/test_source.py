"""Sources of the viewer: folders of runs, motion files, and training."""

from __future__ import annotations

import itertools
import threading
from pathlib import Path

import pytest
from moving_scene import write_moving_run
from view_sessions import looking_at_balls

import dyngs
from dyngs.api.train import train
from dyngs.core.errors import DyngsError
from dyngs.runs.checkpoint import checkpoint_paths
from dyngs.training.events import Event, StepDone
from dyngs.training.trainer import Trainer
from dyngs.view.controls import motion_files
from dyngs.view.session import RenderScheduler, Session
from dyngs.view.source import load_first, open_source
from dyngs.view.training import BetweenStepRenderer, opened_training


def test_a_folder_of_runs_is_a_picker(tmp_path: Path) -> None:
    for name in ("b", "a/deep"):
        write_moving_run(tmp_path / name)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "config.yaml").write_text("model: 3")
    source = open_source(tmp_path)
    assert source.names == ("a/deep/run", "b/run")
    assert not source.load("b/run").scene.is_static
    assert source.load("b/run").name == "b/run"
    next((tmp_path / "a/deep/run/checkpoints").iterdir()).write_bytes(b"damaged")
    first = load_first(source)
    assert first.name == "b/run"
    assert "skipped" in first.notes[0]
    assert open_source(tmp_path / "b" / "run").names == ("run",)


def test_a_folder_without_scenes_is_reported_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="no runs found"):
        open_source(tmp_path)
    with pytest.raises(DyngsError, match="no such file"):
        load_first(open_source(tmp_path / "nothing"))


def test_motion_files_are_found_by_suffix(tmp_path: Path) -> None:
    for name in ("walk.npz", "b/run.BVH", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    assert list(motion_files(tmp_path)) == ["b/run.BVH", "walk.npz"]
    assert list(motion_files(tmp_path / "walk.npz")) == ["walk.npz"]
    assert motion_files(None) == {}
    (tmp_path / "empty").mkdir()
    with pytest.raises(DyngsError, match="no motion files"):
        motion_files(tmp_path / "empty")


class Onlooker:
    """A browser without a browser: it looks at the training from the second step on, and never
    keeps still."""

    def __init__(self) -> None:
        self.drawer = RenderScheduler()
        # an image is due after each step, however fast the machine is
        ticks = itertools.count(step=100.0)
        self.clock = lambda: next(ticks)
        self.drawn = BetweenStepRenderer(self.drawer, fraction=0.9, clock=self.clock)
        self.seen: list[bytes] = []

    def __call__(self, event: Event) -> None:
        match event:
            case StepDone():
                trainer = event.loop.trainer
                assert isinstance(trainer, Trainer)
                if event.step == 2:
                    first = opened_training(trainer)
                    session = Session(
                        first, lambda sent: self.seen.append(sent.image.tobytes()), clock=self.clock
                    )
                    session.on_error = pytest.fail
                    self.drawer.add(session)
                for session in self.drawer.sessions:
                    session.change(divide=event.step / 1000)
                    if session.browser_camera is None:
                        other, _ = looking_at_balls()
                        assert other.browser_camera is not None
                        session.move(other.browser_camera)
                self.drawn.after_step(trainer.model.scene)


@pytest.mark.parametrize("preset", ["static", "dynamic"])
def test_training_gives_the_same_bytes_with_and_without_viewers(
    preset: str, tmp_path: Path, still: Path, moving: Path
) -> None:
    onlooker = Onlooker()
    found = []
    for name, listeners in (("alone", []), ("seen", [onlooker])):
        overrides = [
            f"data.root={still if preset == 'static' else moving}",
            f"run.dir={tmp_path / name}",
        ]
        overrides += ["train.steps=12", "init.num_random=40", "run.threads=1"]
        overrides += ["model.pilot_runs=false"] if preset == "dynamic" else []
        folder = train(dyngs.load_config(preset, overrides), listeners=listeners)
        found.append(checkpoint_paths(folder)[-1].read_bytes())
    assert found[0] == found[1]
    assert len(set(onlooker.seen)) > 2


def test_images_take_no_more_than_their_share() -> None:
    threads = threading.active_count()
    now = [0.0]
    drawer = RenderScheduler()
    session, sent = looking_at_balls()
    scene = session.opened.scene

    def clock() -> float:
        now[0] += 0.01  # whatever is done takes a while
        return now[0]

    drawn = BetweenStepRenderer(drawer, fraction=0.25, clock=clock)
    assert drawn.after_step(scene) == 0.0
    assert now == [0.0]  # without browsers not even the clock is read
    drawer.add(session)
    spent = 0.0
    for _ in range(300):
        now[0] += 0.01  # a step
        session.change(divide=now[0] % 1)
        spent += drawn.after_step(scene)
    assert sent
    assert 0.05 < spent / now[0] < 0.3
    assert threading.active_count() < threads + 20, "not one for each image"
