"""File size budgets: a file stays within its limit, renders as recorded, and is rebuilt when it is
missing."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from dyngs.api.budget.size import write_limited_file
from dyngs.api.train import train
from dyngs.compress.stage import mean_psnr
from dyngs.config import (
    BudgetConfig,
    Config,
    DataConfig,
    OptimConfig,
    RandomInit,
    RunConfig,
    TrainConfig,
)
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.models.static_section import StaticModel
from dyngs.runs.checkpoint import (
    SCENE_FILE,
    checkpoint_paths,
    has_only_scene_file,
    latest_checkpoint,
    load_run,
)
from dyngs.runs.folder import EXPORT_FOLDER
from dyngs.training.new_trainer import build_trainer
from dyngs.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_static_capture(folder, StaticOptions(size=16, num_train=4, num_test=1, samples=1))
    return folder


def config_of(capture: Path, run_dir: Path, budget: BudgetConfig) -> Config:
    return Config(
        data=DataConfig(root=capture),
        model=StaticModel(sh_degree=1),
        init=RandomInit(num_random=500, half_extent=1.3),
        optim=OptimConfig(rate_factor=1),
        train=TrainConfig(steps=12, log_every=4),
        budget=budget,
        run=RunConfig(dir=run_dir, threads=1),
    )


@pytest.fixture(scope="module")
def trainer(still: Path, tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    trainer = build_trainer(config_of(still, tmp_path_factory.mktemp("run"), BudgetConfig()))
    while trainer.done < 12:
        trainer.step()
    return trainer


def test_a_file_fits_its_budget_and_has_the_reported_quality(
    trainer: Trainer, tmp_path: Path
) -> None:
    before = trainer.checkpoint().tensors
    usual = write_limited_file(trainer, tmp_path / "usual", 5.0)
    assert (usual.coarser, usual.num_kept) == (1, 500)
    assert usual.after > usual.before - 0.1, "0.025 dB were meant to be lost"
    for fraction in (0.8, 0.4, 0.15):
        asked = fraction * usual.megabytes
        report = write_limited_file(trainer, tmp_path / str(fraction), asked)
        file = tmp_path / str(fraction) / EXPORT_FOLDER / SCENE_FILE
        assert file.stat().st_size == round(1e6 * report.megabytes) <= 1e6 * asked
        assert report.coarser > 1 or report.num_kept < 500
        assert report.before == usual.before
        assert f"limit {asked:g}" in str(report)
        scene = load_run(file.parent).scene
        assert len(scene) == report.num_kept
        drawn = mean_psnr(trainer, scene, [trainer.images[i] for i in range(4)])
        assert drawn == pytest.approx(report.after), "what is said is what the file shows"
    after = trainer.checkpoint().tensors
    assert {name.partition(".")[0] for name in before.keys() - after.keys()} <= {"strategy"}
    assert all(torch.equal(x, before[name]) for name, x in after.items())


def test_an_unreachable_size_is_reported(trainer: Trainer, tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"budget.max_mb=0.0001: too small for this scene"):
        write_limited_file(trainer, tmp_path, 0.0001)
    assert not (tmp_path / EXPORT_FOLDER).exists()


def test_a_run_writes_the_file_and_a_finished_run_rebuilds_it(still: Path, tmp_path: Path) -> None:
    folder = train(config_of(still, tmp_path / "run", BudgetConfig(max_mb=0.02)))
    file = folder / EXPORT_FOLDER / SCENE_FILE
    end = checkpoint_paths(folder)[-1].read_bytes()
    wanted = file.read_bytes()
    assert len(wanted) <= 20_000
    assert has_only_scene_file(folder / EXPORT_FOLDER)
    assert len(load_run(folder / EXPORT_FOLDER).scene) == len(
        latest_checkpoint(folder).tensors["gaussians.means"]
    )
    shutil.rmtree(folder / EXPORT_FOLDER)
    train(load_resolved(folder), resume_from=folder)
    assert file.read_bytes() == wanted
    (folder / EXPORT_FOLDER / "config.yaml").unlink()  # a kill right after the file was written
    train(load_resolved(folder), resume_from=folder)
    assert len(load_run(folder / EXPORT_FOLDER).scene) > 0
    assert checkpoint_paths(folder)[-1].read_bytes() == end
