"""Run folders: no command replaces files without a request, and leftovers of killed runs are
removed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from dyngs.api.prune import prune_run
from dyngs.api.scene_file import write_scene_file
from dyngs.api.train import train
from dyngs.cli.demo import is_unused
from dyngs.config import Config, DataConfig, RandomInit, RunConfig, TrainConfig
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError
from dyngs.export.splat_files import write_run_sequence
from dyngs.io.outputs import LOCK_NAME, InUseError, lock_folder, require_new_folder
from dyngs.models.static_section import StaticModel
from dyngs.runs.checkpoint import (
    KEEP_CHECKPOINTS,
    checkpoint_paths,
)
from dyngs.runs.folder import remove_partial_files
from dyngs.runs.opened import open_run

pytestmark = pytest.mark.usefixtures("one_thread")

FOREIGN = {
    "notes.txt": "mine",
    "checkpoints/best.pt": "mine",
    ".step_7.txt": "mine",
    "deep/a.png": "mine",
}
OWN = {
    "config": {"config.yaml": "a: foreign file\n"},
    "log": {"log.jsonl": '{"step": 1}\n'},
    "metrics": {"metrics.json": "{}"},
    "scene": {"scene.dyngs": "a model"},
    "export": {"export/scene.dyngs": "a model"},
    "checkpoint": {"checkpoints/step_0000009.safetensors": "a model"},
    "checkpoints is a file": {"checkpoints": "mine"},
    "timing": {"timing.json": "{}"},
}


def config_of(capture: Path, run_dir: Path, seed: int = 42, steps: int = 4) -> Config:
    return Config(
        data=DataConfig(root=capture),
        model=StaticModel(sh_degree=0),
        init=RandomInit(num_random=30),
        train=TrainConfig(steps=steps, log_every=1, save_every=2),
        run=RunConfig(dir=run_dir, threads=1, seed=seed),
    )


@pytest.fixture(scope="module")
def run_dir(still: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(config_of(still, tmp_path_factory.mktemp("runs") / "run"))


def _filled(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def _contents(folder: Path) -> dict[str, bytes]:
    if folder.is_file():
        return {"": folder.read_bytes()}
    return {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


Command = Callable[[Path, Path, Path], object]
"""Of the capture, a run, and where to."""
COMMANDS: dict[str, Command] = {
    "train": lambda capture, run, out: train(config_of(capture, out)),
    "compact": lambda capture, run, out: prune_run(
        run, out, ("prune.fraction=0.5", "prune.steps=1", "run.threads=1")
    ),
    "export": lambda capture, run, out: write_scene_file(run, out),
    "resume": lambda capture, run, out: train(config_of(capture, out), resume_from=out),
    "synth": lambda capture, run, out: require_new_folder(out),
    "sequence": lambda capture, run, out: write_run_sequence(open_run(run), out, (0.0, 1.0)),
    "demo": lambda capture, run, out: _require(is_unused(out)),
}


def _require(holds: bool) -> None:
    if not holds:
        raise DyngsError("another one is taken")


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("state", OWN)
def test_no_command_replaces_existing_files(
    still: Path, run_dir: Path, tmp_path: Path, command: str, state: str
) -> None:
    out = _filled(tmp_path / "out", OWN[state])
    before = _contents(out)
    if command == "sequence":  # it writes no such names
        COMMANDS[command](still, run_dir, out)
        assert before.items() <= _contents(out).items()
        return
    with pytest.raises(DyngsError) as caught:
        COMMANDS[command](still, run_dir, out)
    assert "\n" not in str(caught.value)
    assert _contents(out) == before


def test_a_run_stopped_before_its_first_checkpoint_is_taken_up(
    still: Path, run_dir: Path, tmp_path: Path
) -> None:
    """By the same command or by --resume, and by nothing else."""
    end = checkpoint_paths(run_dir)[-1].read_bytes()
    for resumes in (False, True):
        out = tmp_path / str(resumes)
        out.mkdir()
        for name in ("asked.yaml", "config.yaml"):
            shutil.copyfile(run_dir / name, out / name)
        (out / "log.jsonl").write_text((run_dir / "log.jsonl").read_text()[:50])
        before = _contents(out)
        with pytest.raises(DyngsError, match=r"before its first checkpoint.*--resume"):
            train(config_of(still, out, seed=1))
        assert _contents(out) == before
        train(config_of(still, out), resume_from=out if resumes else None)
        assert checkpoint_paths(out)[-1].read_bytes() == end
        config = (out / "config.yaml").read_text().replace(str(out), str(run_dir))
        assert config == (run_dir / "config.yaml").read_text()
        assert (out / "log.jsonl").read_text().count("\n") == 5  # four steps, and the test views


def test_a_finished_run_is_not_begun_again(still: Path, run_dir: Path) -> None:
    before = _contents(run_dir)
    assert train(config_of(still, run_dir)) == run_dir
    train(load_resolved(run_dir), resume_from=run_dir)
    assert _contents(run_dir) == before


def test_leftovers_of_a_kill_are_removed_on_resume(run_dir: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(run_dir, run)
    left = ["checkpoints/.step_0000004.77-abcdef.dyngs.safetensors"]
    left += [".timing.77-abcdef.dyngs.json", LOCK_NAME]
    kept = [
        ".metrics.77-abcdef.dyngs.json",
        ".timing.json.swp",
        "checkpoints/.step_best.safetensors",
    ]
    for name in (*left, *kept):
        (run / name).write_text("half")
    train(load_resolved(run), resume_from=run)
    assert [path.name for path in checkpoint_paths(run)] == [
        path.name for path in checkpoint_paths(run_dir)
    ]
    assert len(checkpoint_paths(run)) == KEEP_CHECKPOINTS
    assert [name for name in left if (run / name).exists()] == []
    assert [name for name in kept if not (run / name).exists()] == []


@pytest.mark.skipif(sys.platform == "win32", reason="links")
def test_nothing_is_removed_through_a_link(tmp_path: Path) -> None:
    outside = _filled(
        tmp_path / "outside",
        {".step_2.1-abcdef.dyngs.safetensors": "mine", ".a.1-abcdef.dyngs.json": "mine"},
    )
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "checkpoints").symlink_to(outside)
    before = _contents(outside)
    remove_partial_files(tmp_path / "run", sole_writer=True)
    assert _contents(outside) == before


@pytest.mark.skipif(sys.platform == "win32", reason="forks")
def test_a_few_kills_lose_nothing(tmp_path: Path) -> None:
    """The first seconds of benchmarks/soak.py, which does this for long."""
    soak = Path(__file__).parents[2] / "benchmarks" / "soak.py"
    words = [
        sys.executable,
        str(soak),
        "--kills",
        "2",
        "--minutes",
        "1",
        "--jobs",
        "static,prune,export",
    ]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"^\d kills in .*, 0 lost$", done.stdout, re.MULTILINE)


@pytest.mark.parametrize("command", ["train", "export", "resume"])
def test_nothing_is_written_while_another_writes(
    still: Path, run_dir: Path, tmp_path: Path, command: str
) -> None:
    out = tmp_path / "out"
    shutil.copytree(run_dir, out)
    with lock_folder(out):
        before = _contents(out)
        with pytest.raises(InUseError, match=f"process {os.getpid()} on "):
            COMMANDS[command](still, out if command == "export" else run_dir, out)
        assert _contents(out) == before
