"""The benchmark: its counts are exact and its table is complete; times are not tested."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from pretend_gpu import GPU, pretend_gpu
from reference import project, rasterize

from dyngs.cli import main
from dyngs.cli.kernel_bench import (
    STAGES,
    bench_rasterize,
    garden_workload,
    random_workload,
    report_cells,
)
from dyngs.core.errors import DyngsError
from dyngs.ops.projection import ProjectionOptions


@pytest.fixture(autouse=True)
def small_product(monkeypatch: pytest.MonkeyPatch) -> None:
    """The matrix product beside the stages is a small one: no test asks how fast it is."""
    monkeypatch.setattr("dyngs.cli.kernel_bench.SGEMM_SIZE", 64)


def test_counts_agree_with_the_reference() -> None:
    """Pairs are pixels with alpha >= 1/255 that are not full: the reference finds them, one
    Gaussian at a time."""
    load = random_workload(12)
    report = bench_rasterize(load, [1], repeats=1)
    projection = project(
        load.means,
        load.quats,
        load.scales,
        load.opacities,
        load.cameras,
        ProjectionOptions(near=0.01),
    )
    pairs = 0
    for i in range(12):
        alone = torch.zeros(1, 12)
        alone[0, i] = load.opacities[i]
        pairs += int((rasterize(projection, alone, load.colors, load.size).transmittance < 1).sum())
    assert report["pairs"] == pytest.approx(pairs, abs=3)  # alpha within rounding of 1/255


def test_the_table_holds_every_stage() -> None:
    report = bench_rasterize(random_workload(50), [1, 2], repeats=2)
    _, head, cells = report_cells(report)
    assert head[1:] == ["1 thread", "2 threads"]
    assert [row[0] for row in cells[: len(STAGES)]] == list(STAGES)


def test_points_beyond_two_units_are_left_out(tmp_path: Path) -> None:
    points = np.array([[0.0, 0, 3], [0, 0, 1], [0, 1.5, 1]], np.float32)
    path = tmp_path / "points.npz"
    view = np.eye(4, dtype=np.float32)[None]
    arrays = {
        "means3d": points,
        "colors": np.zeros((3, 3), np.uint8),
        "viewmats": view,
        "Ks": np.eye(3)[None],
    }
    np.savez(path, **arrays, width=8, height=6)
    load = garden_workload(path)
    assert len(load.means) == 2
    assert load.size == (8, 6)


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(DyngsError, match=r"missing\.npz"):
        garden_workload(tmp_path / "missing.npz")
    path = tmp_path / "garden.npz"
    right = {
        "means3d": np.zeros((3, 3)),
        "colors": np.zeros((3, 3)),
        "viewmats": np.eye(4)[None],
        "Ks": np.eye(3)[None],
    }
    right |= {"width": 8, "height": 6}
    wrong = {
        "means3d": np.zeros(3),
        "colors": np.zeros((2, 3)),
        "viewmats": np.full((1, 4, 4), np.nan),
        "width": "x",
    }
    for key, value in wrong.items():
        np.savez(path, **(right | {key: np.asarray(value)}))
        with pytest.raises(DyngsError, match=r"garden\.npz.*give a workload"):
            garden_workload(path)
    path.write_bytes(b"PK" + bytes(99))
    with pytest.raises(DyngsError, match=r"garden\.npz"):
        garden_workload(path)
    for arguments in (["bench"], ["bench", "x"], ["bench", "rasterize", "--threads", "0"]):
        assert main(arguments) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_workload_elsewhere_is_measured_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "a GPU")
    expected = bench_rasterize(random_workload(50), [1], repeats=1)
    with pretend_gpu():
        found = bench_rasterize(random_workload(50).to(GPU), [1], repeats=1)
    assert found["pairs"] == expected["pairs"]
    assert report_cells(found)[0].endswith("; a GPU")


def test_a_gpu_that_is_not_there_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    assert main(["bench", "rasterize", "--device", "cuda"]) == 2
    assert capsys.readouterr().err.startswith("dyngs: error: device cuda: ")
