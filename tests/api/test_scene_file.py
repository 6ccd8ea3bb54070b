"""Compact scene files: they render like the run, and training from them is refused."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from moving_scene import write_moving_run

from dyngs.api.scene_file import write_scene_file
from dyngs.core.errors import DyngsError
from dyngs.core.state import add_prefix, strip_roles
from dyngs.gaussians.visibility import VisibilityMasks
from dyngs.runs.checkpoint import latest_checkpoint, load_run, save_checkpoint


@pytest.mark.parametrize("moves", [True, False])
def test_a_prune_run_moves_as_before(tmp_path: Path, moves: bool) -> None:
    run_dir = write_moving_run(tmp_path, moves=moves)
    written = write_scene_file(run_dir, tmp_path / "small", 0.5)
    assert written.num_bytes == written.path.stat().st_size
    assert written.precision.change is not None
    assert written.precision.change <= 0.5
    before = load_run(run_dir)
    after = load_run(tmp_path / "small")
    assert (after.config, after.info) == (before.config, before.info)
    assert after.scene.is_static is not moves
    for time in (0.0, 0.6):
        places = [run.scene.at(time).means[:, 0].sort().values for run in (before, after)]
        torch.testing.assert_close(places[0], places[1], atol=0.1, rtol=0)  # a pixel is 0.2 wide


def test_a_run_with_masks_is_stored_with_them(tmp_path: Path) -> None:
    """Of five balls the first is seen at the first key time only."""
    run_dir = write_moving_run(tmp_path)
    seen = torch.ones(3, 5, dtype=torch.bool)
    seen[1:, 0] = False
    checkpoint = latest_checkpoint(run_dir)
    masks = strip_roles(
        add_prefix("model.masks", VisibilityMasks.pack((0.0, 0.5, 1.0), seen).state())
    )
    save_checkpoint(run_dir, replace(checkpoint, tensors=checkpoint.tensors | masks), 1.0)
    write_scene_file(run_dir, tmp_path / "small", 0.5)
    stored = load_run(tmp_path / "small").scene
    assert [len(stored.at(time)) for time in (0.2, 0.7)] == [5, 4]


def with_outlier(run_dir: Path, **values: float) -> None:
    """Save the run anew with a value of its first Gaussian, behind all cameras, replaced in each
    named attribute."""
    checkpoint = latest_checkpoint(run_dir)
    tensors = {name: x.clone() for name, x in checkpoint.tensors.items()}
    for name, value in values.items():
        tensors[f"gaussians.{name}"][0] = value
    save_checkpoint(run_dir, replace(checkpoint, tensors=tensors), 1.0)


@pytest.mark.parametrize(
    "values", [{"means": 1e8}, {"means": -3e37}, {"means": 1e6, "sh": 1e8, "log_scales": -90.0}]
)
def test_an_outlier_does_not_spoil_the_others(tmp_path: Path, values: dict[str, float]) -> None:
    run_dir = write_moving_run(tmp_path)
    with_outlier(run_dir, **values)
    written = write_scene_file(run_dir, tmp_path / "small", 0.5)
    assert written.precision.change is not None
    assert written.precision.change <= 0.5
    before, after = (
        load_run(folder).scene.at(0.6).means for folder in (run_dir, tmp_path / "small")
    )
    order = [x[:, 0].argsort() for x in (before, after)]
    torch.testing.assert_close(after[order[1]], before[order[0]], atol=0.1, rtol=1e-6)


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"logit_opacities": 3e38},
        {"logit_opacities": -3e38},
        {"sh": 3e38},
        {"quats": 0.0},
        {"quats": 1e-30},
        {"log_scales": 80.0},
        {"log_scales": -1e38},
        {"means": 3e38, "quats": 3e38},
    ],
)
def test_extremes_are_stored_as_they_are_drawn(tmp_path: Path, values: dict[str, float]) -> None:
    run_dir = write_moving_run(tmp_path)
    with_outlier(run_dir, **values)
    change = write_scene_file(run_dir, tmp_path / "small", 1.0).precision.change
    assert change is not None
    assert change <= 1.0
    assert len(load_run(tmp_path / "small").scene) == 5


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("degree", range(5))
def test_no_gaussian_and_one_of_any_degree_are_stored(
    tmp_path: Path, count: int, degree: int
) -> None:
    run_dir = write_moving_run(tmp_path, moves=False)
    checkpoint = latest_checkpoint(run_dir)
    tensors = {name: x[:count].clone() for name, x in checkpoint.tensors.items()}
    tensors["gaussians.sh"] = torch.ones(count, (degree + 1) ** 2, 3)
    save_checkpoint(run_dir, replace(checkpoint, tensors=tensors), 1.0)
    write_scene_file(run_dir, tmp_path / "small", 1.0)
    assert tuple(load_run(tmp_path / "small").scene.gaussians.sh.shape) == (
        count,
        (degree + 1) ** 2,
        3,
    )


def test_without_its_capture_steps_are_assumed(tmp_path: Path) -> None:
    run_dir = write_moving_run(tmp_path)
    shutil.rmtree(tmp_path / "capture")
    assert write_scene_file(run_dir, tmp_path / "small").precision.change is None
    assert len(load_run(tmp_path / "small").scene) == 5


def test_training_from_a_scene_file_and_damaged_files_are_refused(tmp_path: Path) -> None:
    written = write_scene_file(write_moving_run(tmp_path), tmp_path / "small")
    with pytest.raises(DyngsError, match="no checkpoints"):
        latest_checkpoint(tmp_path / "small")
    written.path.write_bytes(written.path.read_bytes()[:-40])
    with pytest.raises(DyngsError, match=r"scene.dyngs: damaged or cut off"):
        load_run(tmp_path / "small")
