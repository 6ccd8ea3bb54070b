"""The benchmark of deformation fields: whole reports, the right number of moving Gaussians, one line for bad input."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from moving_scene import write_moving_run
from tiny_fields import KINDS, busy_config, tiny_options, write_tiny_capture

from dyngs.api.train import train
from dyngs.bench.deform import (
    FIELD_STAGES,
    VARIANTS,
    DeformLoad,
    DeformReport,
    bench_deform,
    format_report,
    load_of_run,
    synthetic_load,
    write_report,
)
from dyngs.cli import main
from dyngs.config import DynamicModel, RandomInit, StaticModel
from dyngs.errors import DyngsError


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_capture(tmp_path_factory.mktemp("capture") / "moving")


def _load(capture: Path, kind: str, moving_fraction: float) -> DeformLoad:
    """Sixty random Gaussians."""
    config = busy_config(capture, capture, kind)
    return DeformLoad(
        config.model_copy(update={"model": DynamicModel(deform=tiny_options(kind))}), None, moving_fraction
    )


def _check(report: DeformReport, num_gaussians: int, num_moving: int) -> None:
    assert (report.num_gaussians, report.num_moving) == (num_gaussians, num_moving)
    assert report.threads == 1
    assert tuple(report.steps) == VARIANTS
    assert tuple(report.stages) == FIELD_STAGES
    assert all(ms > 0 for ms in report.steps.values())
    assert all(ms >= 0 for ms in report.stages.values())
    assert 0 <= report.field_fraction < 1


@pytest.mark.parametrize("kind", KINDS)
def test_the_report_is_whole(capture: Path, tmp_path: Path, kind: str) -> None:
    report = bench_deform(_load(capture, kind, 0.25), threads=1, rounds=1)
    _check(report, 60, 15)
    assert report.kind == kind
    text = format_report(report)
    assert all(name in text for name in (*VARIANTS, *FIELD_STAGES, "60 Gaussians, 15 (25.0%) move", "static split"))
    write_report(report, tmp_path / "bench.json")
    written = json.loads((tmp_path / "bench.json").read_text())
    assert set(written["steps"]) == set(VARIANTS)
    assert written["field_fraction"] == report.field_fraction


@pytest.mark.parametrize(("fraction", "num_moving"), [(1.0, 60), (0.001, 0)])
def test_all_or_none_may_move(capture: Path, fraction: float, num_moving: int) -> None:
    for kind in KINDS:
        _check(bench_deform(_load(capture, kind, fraction), threads=1, rounds=1), 60, num_moving)


def test_a_run_is_measured_with_what_moves_in_it(capture: Path, tmp_path: Path) -> None:
    run = train(busy_config(capture, tmp_path / "run", "control_nodes"))
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    last = json.loads((run / "log.jsonl").read_text().splitlines()[-1])
    _check(bench_deform(load_of_run(run), threads=1, rounds=1), last["num_gaussians"], last["num_moving"])
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


def test_the_synthetic_load_is_as_asked_for(tmp_path: Path) -> None:
    load = synthetic_load(tmp_path / "room", 1234, 0.2, "mlp")
    assert isinstance(load.config.model, DynamicModel)
    assert load.config.model.deform.kind == "mlp"
    assert isinstance(load.config.init, RandomInit)
    assert (load.config.init.num_random, load.moving_fraction, load.run_dir) == (1234, 0.2, None)


def test_shares_are_within_bounds() -> None:
    """Noise may make a step in which something moves the faster one."""
    stages = dict.fromkeys(FIELD_STAGES, 1.0)

    def fraction(still: float, moving: float) -> float:
        steps = dict(zip(VARIANTS, (still, moving, 9.0), strict=True))
        return DeformReport("v3", 1, "mlp", 10, 1, steps, stages).field_fraction

    assert fraction(6.0, 8.0) == pytest.approx(0.25)
    assert fraction(8.0, 6.0) == 0.0


@pytest.mark.parametrize(
    "arguments",
    [
        ["--moving", "0"],
        ["--moving", "1.5"],
        ["--moving", "nan"],
        ["--gaussians", "0"],
        ["--repeats", "0"],
        ["--threads", "0"],
        ["--threads", "-1"],
        ["--kind", "splines"],
        ["no such run"],
    ],
    ids=" ".join,
)
def test_bad_arguments_are_one_line(
    arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And nothing is measured."""
    monkeypatch.setattr("dyngs.bench.deform.bench_deform", None)
    assert main(["bench", "deform", *arguments]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_the_command_prints_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--kind", "control_nodes", "--gaussians", "40", "--moving", "0.5", "--threads", "1", "--repeats", "1"]
    assert main(["bench", "deform", *arguments, "--json", str(tmp_path / "bench.json")]) == 0
    assert "control_nodes: 40 Gaussians, 20 (50.0%) move; 1 thread(s)" in capsys.readouterr().out
    assert json.loads((tmp_path / "bench.json").read_text())["num_moving"] == 20


def test_loads_in_which_nothing_can_move_are_refused(capture: Path, tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="nothing moves in this run"):
        load_of_run(write_moving_run(tmp_path, moves=False))
    still = busy_config(capture, capture, "mlp").model_copy(update={"model": StaticModel()})
    with pytest.raises(DyngsError, match=r"nothing can move in it|kind=dynamic"):
        bench_deform(DeformLoad(still), threads=1, rounds=1)
