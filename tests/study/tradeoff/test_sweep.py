"""A whole sweep of a tiny run: measured once, resumed, reported, chosen from."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from pretend_gpu import GPU, pretend_gpu
from tiny_fields import busy_config, write_tiny_capture

from dyngs.api.train import train
from dyngs.config import DynamicModel
from dyngs.config.io import load_resolved, save_config
from dyngs.core.errors import DyngsError
from dyngs.evaluate.report import evaluate_run
from dyngs.runs.checkpoint import has_only_scene_file, load_run
from dyngs.study.tradeoff.measure import Measurement, read_measurement, variant_drawing
from dyngs.study.tradeoff.report import write_report
from dyngs.study.tradeoff.sweep import Plan, sweep
from dyngs.study.tradeoff.table import table_rows
from dyngs.study.tradeoff.variant_runs import VariantRuns, field_changes, run_settings, write_chosen
from dyngs.study.tradeoff.variants import Variant, parse_variations

pytestmark = pytest.mark.usefixtures("one_thread")
SETTINGS = (
    "prune=0.5",
    "mask_times=3",
    "sh_degree=0",
    "storage=2",
    "field_step=64",
    "alpha_min=0.02",
    "scale=0.5",
)
PLAN = Plan(parse_variations(SETTINGS, trains=False), finetune=2, combine=1, rounds=1)


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    return train(
        busy_config(write_tiny_capture(folder / "capture"), folder / "run", "control_nodes")
    )


@pytest.fixture(scope="module")
def runs(run_dir: Path) -> VariantRuns:
    return VariantRuns(run_dir, run_dir / "tradeoff", 1)


@pytest.fixture(scope="module")
def points(runs: VariantRuns) -> list[Measurement]:
    return sweep(runs, PLAN, lambda line: None)


def named(points: list[Measurement], variant: Variant) -> Measurement:
    return next(p for p in points if p.variant == variant)


def test_the_run_itself_is_what_eval_says(points: list[Measurement], run_dir: Path) -> None:
    report = evaluate_run(run_dir, "test", threads=1)
    base = points[0]
    assert base.variant == Variant()
    assert (base.psnr, base.ssim) == pytest.approx((report.psnr, report.ssim))
    assert (base.num_views, base.num_gaussians) == (report.num_views, report.num_gaussians)
    assert base.gain == 1.0


def test_every_setting_does_what_it_says(points: list[Measurement]) -> None:
    base = points[0]
    pruned = named(points, Variant(prune=0.5))
    assert pruned.num_gaussians == base.num_gaussians / 2
    assert pruned.mb < 0.75 * base.mb  # what moves is worth more and holds more numbers
    assert named(points, Variant(prune=0.5, finetune=2)).num_gaussians == pruned.num_gaussians
    assert named(points, Variant(sh_degree=0)).mb < base.mb
    assert named(points, Variant(storage=2.0)).mb < 0.5 * base.mb
    coarser = named(points, Variant(storage="auto", field_step=64.0))
    assert coarser.psnr != base.psnr
    for variant in (Variant(alpha_min=0.02), Variant(scale=0.5)):
        assert named(points, variant).mb == base.mb
        assert named(points, variant).psnr != base.psnr
    assert all(p.speed is not None and p.speed.ms.median > 0 for p in points)
    assert all(p.memory_mb is None or p.memory_mb > 0 for p in points)


def test_combinations_are_measured_too(points: list[Measurement]) -> None:
    together = [p for p in points if p.variant.setting == "several"]
    assert 0 < len(together) <= 3 * PLAN.combine


def test_finished_points_are_not_measured_again(
    points: list[Measurement], runs: VariantRuns
) -> None:
    said: list[str] = []
    files = sorted((runs.out / "points").iterdir())
    times = [file.stat().st_mtime_ns for file in files]
    assert sweep(runs, PLAN, said.append) == points
    assert said == []
    assert [file.stat().st_mtime_ns for file in files] == times
    assert [read_measurement(file).variant.slug for file in files] == [file.stem for file in files]


def test_points_of_something_else_do_not_mix(
    points: list[Measurement], runs: VariantRuns, tmp_path: Path
) -> None:
    with pytest.raises(DyngsError, match=r"another study .split is test there and train here"):
        sweep(runs, replace(PLAN, split="train"), lambda line: None)
    with pytest.raises(DyngsError, match="no views"):
        sweep(VariantRuns(runs.run_dir, tmp_path, 1), replace(PLAN, split="val"), lambda line: None)


def test_on_a_gpu_quality_is_the_same(
    runs: VariantRuns, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # of the CPU alone
    monkeypatch.setattr("dyngs.study.tradeoff.memory.MemoryMeter.peak_megabytes", lambda *_: None)
    briefly = replace(
        PLAN, settings=parse_variations(("prune=0.5",), trains=False), finetune=0, combine=0
    )
    expected = sweep(VariantRuns(runs.run_dir, tmp_path / "here", 1), briefly, lambda line: None)
    monkeypatch.setattr("dyngs.training.new_trainer.device_for", lambda _: GPU)
    with pretend_gpu():
        there = VariantRuns(runs.run_dir, tmp_path / "there", 1)
        found = sweep(there, replace(briefly, device=GPU), lambda line: None)
    assert [replace(x, speed=None) for x in found] == [replace(x, speed=None) for x in expected]
    with pytest.raises(DyngsError, match=r"another study .device is"):
        sweep(there, briefly, lambda line: None)


def test_the_report_has_every_point(points: list[Measurement], runs: VariantRuns) -> None:
    table, values, page, image, pixels = write_report(runs.out, points)
    assert pixels.read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert [row["name"] for row in rows] == [p.variant.name for p in points]
    assert float(rows[0]["fps"]) == pytest.approx(table_rows(points)[0].fps)
    stored = json.loads(values.read_text())
    assert [Variant(**p["changes"]) for p in stored["points"]] == [p.variant for p in points]
    settings = {e["setting"] for e in stored["exchange_rates"]}
    assert settings >= {"prune", "prune + finetune", "storage", "storage + field_step"}
    assert image.read_text() in page.read_text()
    assert "src=" not in page.read_text()


def test_without_matplotlib_there_is_no_plot(
    points: list[Measurement], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dyngs.study.tradeoff.report.can_plot", lambda: False)
    files = write_report(tmp_path, points)
    assert [file.suffix for file in files] == [".csv", ".json", ".html"]
    assert "<svg" not in files[2].read_text()


def test_the_chosen_run_is_drawn_as_it_was_measured(
    points: list[Measurement], runs: VariantRuns
) -> None:
    variant = Variant(
        prune=0.5, mask_times=3, storage=2.0, mode="antialiased", alpha_min=0.02, scale=0.5
    )
    folder = write_chosen(runs, variant)
    chosen = load_run(folder)
    assert has_only_scene_file(folder)
    assert len(chosen.scene) == points[0].num_gaussians / 2
    assert chosen.config.data.downscale == 2 * load_resolved(runs.run_dir).data.downscale
    assert chosen.scene.masks is not None
    measured = variant_drawing(variant, load_run(runs.run_dir).scene, torch.zeros(3))
    assert chosen.scene.options == measured.options
    for single in (Variant(sh_degree=0), Variant(alpha_min=0.02), Variant(storage=2.0)):
        folder = write_chosen(runs, single)
        assert evaluate_run(folder, "test", threads=1).psnr == pytest.approx(
            named(points, single).psnr
        )


@pytest.mark.parametrize(
    ("variant", "kind", "size"),
    [
        (Variant(field_size=0.5), "control_nodes", {"nodes": 256}),
        (Variant(field="control_nodes", field_size=0.25), "control_nodes", {"nodes": 128}),
        (Variant(field="hexplane"), "hexplane", {"channels": 32}),
    ],
)
def test_another_field_moves_the_same(
    variant: Variant, kind: str, size: dict[str, int], run_dir: Path, tmp_path: Path
) -> None:
    before = load_resolved(run_dir, ["model.deform.nodes=512", "model.deform.moves=[rotations]"])
    save_config(before, tmp_path / "config.yaml")
    changed = load_resolved(tmp_path, field_changes(before, variant)).model
    assert isinstance(changed, DynamicModel)
    assert changed.deform.kind == kind
    assert {name: getattr(changed.deform, name) for name in size} == size
    assert changed.deform.moves == ("rotations",)


def test_free_primitives_are_tried_and_left(run_dir: Path, tmp_path: Path) -> None:
    """They have no size and always the same attributes; other fields then have their defaults."""
    before = load_resolved(run_dir)
    save_config(before, tmp_path / "config.yaml")
    free = load_resolved(tmp_path, field_changes(before, Variant(field="free")))
    assert isinstance(free.model, DynamicModel)
    assert free.model.deform.kind == "free"
    assert list(field_changes(free, Variant(field_size=0.5))) == []
    assert "model.deform.kind=hexplane" in list(field_changes(free, Variant(field="hexplane")))


def test_masks_that_a_run_has_stay(
    points: list[Measurement], runs: VariantRuns, tmp_path: Path
) -> None:
    masked = VariantRuns(
        runs.out / "training" / Variant(mask_times=3, finetune=2).slug, tmp_path, 1
    )
    assert run_settings(masked.run_dir)["mask_times"] == 3
    for variant in (Variant(prune=0.5), Variant(prune=0.5, finetune=1)):
        scene = load_run(masked.folder(variant)).scene
        assert scene.masks is not None
        assert len(scene.masks.times) == 3


def test_what_cannot_be_varied_is_named(runs: VariantRuns) -> None:
    said: list[str] = []
    sweep(
        runs,
        replace(PLAN, settings=parse_variations(["sh_degree=3"], trains=False), combine=0),
        said.append,
    )
    assert said == ["nothing to vary in this run: sh_degree"]


def test_a_stored_run_cannot_be_varied(points: list[Measurement], runs: VariantRuns) -> None:
    with pytest.raises(
        DyngsError, match=r"only scene\.dyngs is there; give the run that it was exported from"
    ):
        run_settings(runs.folder(Variant(storage=2.0)))


def test_a_damaged_point_says_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    point = '{"variant": {}, "num_views": 3, "psnr": %s, "ssim": 0.9, "lpips": null, "num_gaussians": 5, "mb": 1.5'
    point += ', "memory_mb": null, "speed": %s}'
    path.write_text(point % (30.5, "null"))
    assert read_measurement(path).psnr == 30.5
    spread, zero = (f'{{"median": {n}, "low": 1, "high": 2}}' for n in (1.5, 0))
    bad = [
        point % (psnr, "null") for psnr in ("NaN", "1e999", "[1]", '"x"', "[" * 5000 + "]" * 5000)
    ]
    bad += [
        point % (30, f'{{"ms": {ms}, "gain": {gain}}}')
        for ms, gain in ((zero, spread), (spread, zero), (1, spread))
    ]
    for text in ("", "[]", "{}", '{"variant": {"prine": 1}, "speed": null}', *bad):
        path.write_text(text)
        with pytest.raises(DyngsError, match=r"x\.json: .* no measurement of a variant: remove it"):
            read_measurement(path)
