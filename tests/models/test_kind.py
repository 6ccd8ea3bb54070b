"""A kind of another package goes all the way: its keys, training, resuming, evaluation, images, the
viewer; and without the package one line names it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from toy_plugin import FOLDER, installed

import dyngs
from dyngs.api.train import train
from dyngs.cli import main
from dyngs.config.io import load_config
from dyngs.config.kinds import BUILT_IN, GROUP
from dyngs.config.schema import config_keys
from dyngs.core.errors import DyngsError
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.evaluate.report import evaluate_run
from dyngs.export.choose_path import PathOptions, choose_path
from dyngs.export.images import OutputOptions, write_path_images
from dyngs.runs.checkpoint import checkpoint_paths
from dyngs.runs.opened import open_run
from dyngs.view.layers import ViewRequest, draw
from dyngs.view.views import initial_viewpoint

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True, scope="module")
def toy() -> Iterator[None]:
    with installed():
        yield


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_static_capture(folder, StaticOptions(size=24, num_train=6, num_test=2, samples=1))
    return folder


def options(capture: Path, run: Path, steps: int = 40) -> list[str]:
    keys = [f"train.steps={steps}", "train.save_every=20"]
    return [f"data.root={capture}", f"run.dir={run}", "run.threads=1", "model.kind=toy", *keys]


@pytest.fixture(scope="module")
def run(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(load_config(None, options(capture, tmp_path_factory.mktemp("runs") / "toy")))


def test_our_own_kinds_are_entry_points_of_the_package() -> None:
    tomllib = pytest.importorskip("tomllib")  # Python 3.11
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["entry-points"][GROUP] == BUILT_IN


def dyngs_command(*words: str, plugin: bool) -> subprocess.CompletedProcess[str]:
    """Run a command in a new process, with or without the package."""
    tested = Path(dyngs.__file__).resolve().parents[1]  # not the source tree, which has no core
    folders = [str(tested), *([str(FOLDER)] if plugin else [])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(folders)}
    command = [sys.executable, "-m", "dyngs", *words]
    return subprocess.run(
        command, env=environment, cwd=FOLDER.parent, capture_output=True, text=True, check=False
    )


def test_a_run_needs_the_package_of_its_kind(capture: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    trained = dyngs_command("train", *options(capture, run, steps=2), plugin=True)
    assert trained.returncode == 0, trained.stderr
    assert dyngs_command("eval", str(run), plugin=True).returncode == 0
    without = dyngs_command("eval", str(run), plugin=False)
    assert without.returncode == 2
    assert without.stderr.strip().count("\n") == 0
    assert "model.kind=toy needs the package dyngs-toy, which is not installed" in without.stderr


def test_its_keys_are_listed_and_validated(capture: Path, tmp_path: Path) -> None:
    keys = {key.name: key for key in config_keys() if key.kinds == ("toy",)}
    assert keys["model.lr"].allowed == "a number > 0"
    assert keys["model.lr"].default == "0.3"
    assert keys["model.lr"].description == "learning rate"
    words = options(capture, tmp_path)
    with pytest.raises(DyngsError, match=r"model\.lr must be a number > 0, not -1"):
        load_config(None, [*words, "model.lr=-1"])
    with pytest.raises(DyngsError, match="did you mean 'toy'"):
        load_config(None, [*words, "model.kind=toi"])


def test_it_learns_and_resumes_with_the_same_bytes(
    run: Path, capture: Path, tmp_path: Path
) -> None:
    middle, last = checkpoint_paths(run)
    again = train(load_config(None, options(capture, tmp_path / "again")))
    checkpoint_paths(again)[-1].unlink()
    assert [path.name for path in checkpoint_paths(again)] == [middle.name]
    assert main(["train", "--resume", str(again)]) == 0
    assert checkpoint_paths(again)[-1].read_bytes() == last.read_bytes()


def test_it_is_evaluated_drawn_and_viewed(run: Path, tmp_path: Path) -> None:
    report = evaluate_run(run)
    assert report.psnr > 14, "a white image has 10 dB"
    assert (report.num_gaussians, report.num_moving) == (0, 0)
    opened = open_run(run)
    path = choose_path(opened, PathOptions(num_frames=3))
    assert len(write_path_images(opened, path, tmp_path, OutputOptions(depth=True))) == 3 * 3
    start = initial_viewpoint(opened).start
    for shot in (
        ViewRequest(start),
        ViewRequest(start, layer="depth"),
        ViewRequest(start, layer="error", view=0),
    ):
        assert draw(opened, shot).std() > 0


@pytest.mark.parametrize(
    ("command", "part"),
    [
        ("export RUN --out OUT/scene.ply", "Gaussians"),
        ("prune RUN --out OUT/pruned", "Gaussians"),
        ("train --resume RUN budget.max_mb=1 train.steps=50", "budget.max_mb"),
    ],
)
def test_what_needs_gaussians_refuses_it_in_a_line(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, part: str
) -> None:
    words = command.replace("RUN", str(run)).replace("OUT", str(tmp_path)).split()
    assert main(words) == 2
    said = capsys.readouterr().err.strip()
    assert part in said
    assert len(said.splitlines()) == 1
