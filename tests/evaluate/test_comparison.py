"""Numbers side by side are those that `dyngs eval` gives for each run alone."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_fields import busy_config

from dyngs.api.scene_file import write_scene_file
from dyngs.api.train import train
from dyngs.evaluate.report import compare_runs, evaluate_run

pytestmark = pytest.mark.usefixtures("one_thread")


def test_a_run_and_its_file(moving: Path, tmp_path: Path) -> None:
    run = train(busy_config(moving, tmp_path / "run", "control_nodes"))
    file = write_scene_file(run, tmp_path / "file").path
    costs = compare_runs([run, file.parent], 1)
    for folder, cost in zip((run, file.parent), costs, strict=True):
        report = evaluate_run(folder, "test", threads=1)
        assert cost.num_gaussians == report.num_gaussians
        # eval does not clamp what it draws
        assert cost.psnr_test == pytest.approx(report.psnr, abs=0.5)
        assert cost.megabytes == report.model_mb
        assert cost.stored == report.stored_mb
        assert cost.fps > 0
    assert costs[0].stored is None
    assert costs[1].stored == 1e-6 * file.stat().st_size
