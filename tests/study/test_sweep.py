"""A whole sweep of a tiny run: measured once, resumed, reported, chosen from."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from pretend_gpu import GPU, pretend_gpu
from tiny_fields import busy_config, write_tiny_capture

from dyngs.api.train import train
from dyngs.config.io import load_resolved, save_config
from dyngs.core.errors import DyngsError
from dyngs.deform.keys import DynamicModel
from dyngs.evaluate.report import evaluate_run
from dyngs.runs.checkpoint import has_only_scene_file, load_run
from dyngs.study.measure import Measurement, read_measurement
from dyngs.study.sweep import Plan, sweep
from dyngs.study.variant_runs import VariantRuns, field_changes, run_settings, write_chosen
from dyngs.study.variants import Variant, parse_variations

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
    return sweep(runs, PLAN)


def named(points: list[Measurement], variant: Variant) -> Measurement:
    return next(p for p in points if p.variant == variant)


def test_the_run_itself_is_what_eval_says(points: list[Measurement], run_dir: Path) -> None:
    report = evaluate_run(run_dir, "test", threads=1)
    base = points[0]
    assert base.variant == Variant()
    assert (base.psnr, base.ssim) == pytest.approx((report.psnr, report.ssim))
    assert (base.num_views, base.gaussians) == (report.num_views, report.num_gaussians)
    assert base.gain == 1.0


def test_every_setting_does_what_it_says(points: list[Measurement]) -> None:
    base = points[0]
    pruned = named(points, Variant(prune=0.5))
    assert pruned.gaussians == base.gaussians / 2
    assert pruned.mb < 0.75 * base.mb  # what moves is worth more and holds more numbers
    assert named(points, Variant(prune=0.5, finetune=2)).gaussians == pruned.gaussians
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
    points: list[Measurement], runs: VariantRuns, capsys: pytest.CaptureFixture[str]
) -> None:
    files = sorted((runs.out / "points").iterdir())
    times = [file.stat().st_mtime_ns for file in files]
    capsys.readouterr()
    assert sweep(runs, PLAN) == points
    assert capsys.readouterr().out == ""
    assert [file.stat().st_mtime_ns for file in files] == times


def test_points_of_something_else_do_not_mix(
    points: list[Measurement], runs: VariantRuns, tmp_path: Path
) -> None:
    with pytest.raises(DyngsError, match=r"another study .split is test there and train here"):
        sweep(runs, replace(PLAN, split="train"))
    with pytest.raises(DyngsError, match="no views"):
        sweep(VariantRuns(runs.run_dir, tmp_path, 1), replace(PLAN, split="val"))


def test_on_a_gpu_quality_is_the_same(
    runs: VariantRuns, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = parse_variations(("prune=0.5",), trains=False)
    briefly = replace(PLAN, settings=settings, finetune=0, combine=0, has_memory=False)
    expected = sweep(VariantRuns(runs.run_dir, tmp_path / "here", 1), briefly)
    for module in ("training.new_trainer", "study.measure", "study.sweep"):
        monkeypatch.setattr(f"dyngs.{module}.device_for", lambda _: GPU)
    there = VariantRuns(runs.run_dir, tmp_path / "there", 1)
    with pretend_gpu():
        found = sweep(there, briefly)
    assert [replace(x, speed=None) for x in found] == [replace(x, speed=None) for x in expected]
    monkeypatch.undo()
    with pytest.raises(DyngsError, match=r"another study .device is"):
        sweep(there, briefly)


def test_the_chosen_run_is_drawn_as_it_was_measured(
    points: list[Measurement], runs: VariantRuns
) -> None:
    variant = Variant(
        prune=0.5, mask_times=3, storage=2.0, mode="antialiased", alpha_min=0.02, scale=0.5
    )
    folder = write_chosen(runs, variant)
    chosen = load_run(folder)
    assert has_only_scene_file(folder)
    assert len(chosen.scene) == points[0].gaussians / 2
    assert chosen.config.data.downscale == 2 * load_resolved(runs.run_dir).data.downscale
    assert chosen.scene.masks is not None
    options = replace(load_run(runs.run_dir).scene.options, **variant.drawn)
    assert chosen.scene.options == options
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


def test_what_cannot_be_varied_is_named(
    points: list[Measurement], runs: VariantRuns, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = parse_variations(["sh_degree=3"], trains=False)
    capsys.readouterr()
    sweep(runs, replace(PLAN, settings=settings, combine=0))
    assert capsys.readouterr().out == "nothing to vary in this run: sh_degree\n"


def test_a_stored_run_cannot_be_varied(points: list[Measurement], runs: VariantRuns) -> None:
    with pytest.raises(
        DyngsError, match=r"only scene\.dyngs is there; give the run that it was exported from"
    ):
        run_settings(runs.folder(Variant(storage=2.0)))


def test_a_damaged_point_says_what_to_do(points: list[Measurement], tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    good = json.loads(json.dumps(asdict(points[0])))
    path.write_text(json.dumps(good))
    assert read_measurement(path) == points[0]
    bad = [json.dumps(good | {"psnr": value}) for value in ([1], "x", None)]
    bad += [
        json.dumps(good | {"psnr": 1}).replace('"psnr": 1', f'"psnr": {n}')
        for n in ("NaN", "1e999")
    ]
    zero = {"median": 0, "low": 1, "high": 2}
    bad += [json.dumps(good | {"speed": {"ms": zero, "gain": zero}}), "", "[]", "{}", "[" * 5000]
    for text in bad:
        path.write_text(text)
        with pytest.raises(DyngsError, match=r"x\.json: .* no result of a study: remove it"):
            read_measurement(path)
