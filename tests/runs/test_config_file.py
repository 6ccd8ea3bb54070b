"""A run of a person keeps the fit that it was trained on, wherever the fit lay and wherever the
folder goes."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import dyngs
from dyngs.api.train import train
from dyngs.cli import main
from dyngs.config import Config
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError
from dyngs.evaluate.report import evaluate_run
from dyngs.runs.checkpoint import latest_checkpoint
from dyngs.runs.folder import is_same_body, share_body_path

pytestmark = pytest.mark.usefixtures("one_thread")


def fit_of(person: Path, folder: Path, raised: float = 0.01) -> Path:
    """A fit that differs from the body parameters of the capture."""
    folder.mkdir(parents=True)
    for name in ("body_train.npz", "body_pose.npz"):
        arrays = dict(np.load(person / name))
        np.savez(
            folder / name,
            **(arrays | {"trans": arrays["trans"] + np.array([0, raised, 0], np.float32)}),
        )
    (folder / "fit_report.json").write_text("{}")
    (folder / "fit_overlays.png").write_bytes(b"an image")
    return folder


def config_of(person: Path, fit: Path, run_dir: Path) -> Config:
    words = [
        f"data.root={person}",
        f"data.body={fit}",
        f"run.dir={run_dir}",
        "run.threads=1",
        "train.steps=3",
    ]
    return dyngs.load_config("human", [*words, "train.log_every=1", "model.resolution=24"])


def test_a_moved_run_needs_no_cache(
    person: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fit = fit_of(person, tmp_path / "cache" / "bodies" / "person.1")
    config = config_of(person, fit, tmp_path / "run")
    run = train(config)
    assert sorted(path.name for path in (run / "body").iterdir()) == [
        *("body_pose.npz", "body_train.npz", "fit_report.json")
    ]
    assert not (run / "asked.yaml").exists(), "the same body, elsewhere"
    before = evaluate_run(run, "pose")
    capsys.readouterr()
    train(config)
    assert "run already finished" in capsys.readouterr().out
    shutil.rmtree(tmp_path / "cache")
    moved = tmp_path / "elsewhere" / "moved"
    moved.parent.mkdir()
    run.rename(moved)
    assert load_resolved(moved).data.body == moved / "body"
    assert evaluate_run(moved, "pose").psnr == before.psnr
    assert main(["train", "--resume", str(moved), "train.steps=5"]) == 0
    assert latest_checkpoint(moved).info.step == 5
    assert load_resolved(moved).data.body == moved / "body"
    assert "body: body\n" in (moved / "config.yaml").read_text()


def test_bodies_are_the_same_by_their_contents(person: Path, tmp_path: Path) -> None:
    one = fit_of(person, tmp_path / "one")
    two = fit_of(person, tmp_path / "two")
    other = fit_of(person, tmp_path / "other", raised=0.02)
    assert is_same_body(one, two)
    assert is_same_body(None, None)
    assert is_same_body(tmp_path / "gone", tmp_path / "gone")
    for different in (other, None, tmp_path / "gone"):
        assert not is_same_body(one, different)
        assert not is_same_body(different, one)
    (two / "body_pose.npz").unlink()
    assert not is_same_body(one, two)
    first, second = (config_of(person, fit, tmp_path / "run") for fit in (one, other))
    assert share_body_path(second, first) == second


def test_another_fit_is_another_run(person: Path, tmp_path: Path) -> None:
    train(config_of(person, fit_of(person, tmp_path / "one"), tmp_path / "run"))
    with pytest.raises(DyngsError, match="already contains a run"):
        train(config_of(person, fit_of(person, tmp_path / "two", raised=0.02), tmp_path / "run"))
