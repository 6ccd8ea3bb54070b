"""A sweep of a tiny run: measured once, resumed; variants, the front and combinations by known
answers."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pretend_gpu import GPU, pretend_gpu
from tiny_fields import busy_config, write_tiny_capture

from dyngs.api.train import train
from dyngs.core.errors import DyngsError
from dyngs.evaluate.report import evaluate_run
from dyngs.runs.checkpoint import has_only_scene_file, load_run
from dyngs.study.measure import Measurement, read_measurement
from dyngs.study.tradeoff import (
    Tradeoff,
    Variant,
    build_rows,
    combinations,
    current_settings,
    pareto_mask,
    parse_variations,
    single_setting_variants,
)

pytestmark = pytest.mark.usefixtures("one_thread")
SETTINGS = ("prune=0.5", "mask_times=3", "sh_degree=0", "storage=2", "alpha_min=0.02")
Found = dict[Variant, Measurement]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Tradeoff:
    folder = tmp_path_factory.mktemp("runs")
    run = train(
        busy_config(write_tiny_capture(folder / "capture"), folder / "run", "control_nodes")
    )
    settings = parse_variations(SETTINGS)
    return Tradeoff(run, run / "tradeoff", settings, finetune=2, combine=1, threads=1)


@pytest.fixture(scope="module")
def found(study: Tradeoff) -> Found:
    return study.run()


def test_the_unchanged_variant_has_the_scores_of_eval(found: Found, study: Tradeoff) -> None:
    report = evaluate_run(study.run_dir, "test", threads=1)
    base = found[Variant()]
    assert (base.psnr, base.ssim) == (report.psnr, report.ssim)
    assert (base.num_views, base.gaussians) == (report.num_views, report.num_gaussians)
    assert base.gain == 1.0


def test_every_setting_has_its_effect(found: Found) -> None:
    base = found[Variant()]
    pruned = found[Variant(prune=0.5)]
    assert pruned.gaussians == base.gaussians / 2
    assert pruned.mb < 0.75 * base.mb  # what moves is worth more and holds more numbers
    assert found[Variant(prune=0.5, finetune=2)].gaussians == pruned.gaussians
    assert found[Variant(sh_degree=0)].mb < base.mb
    assert found[Variant(storage=2.0)].mb < 0.5 * base.mb
    assert found[Variant(alpha_min=0.02)].mb == base.mb
    assert found[Variant(alpha_min=0.02)].psnr != base.psnr
    assert all(m.ms is not None and m.ms > 0 for m in found.values())
    assert 0 < sum(variant.setting == "several" for variant in found) <= 3


def test_finished_points_are_not_measured_again(found: Found, study: Tradeoff) -> None:
    files = sorted((study.out / "points").iterdir())
    times = [file.stat().st_mtime_ns for file in files]
    assert study.run() == found
    assert [file.stat().st_mtime_ns for file in files] == times


def test_points_of_something_else_do_not_mix(found: Found, study: Tradeoff, tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"another study .split: test there, train here"):
        replace(study, split="train").run()
    with pytest.raises(DyngsError, match="no views"):
        replace(study, out=tmp_path, split="val").run()


def test_on_a_gpu_quality_is_the_same(
    study: Tradeoff, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    briefly = replace(study, settings={"prune": (0.5,)}, finetune=0, combine=0)
    expected = replace(briefly, out=tmp_path / "here").run()
    for module in ("training.new_trainer", "study.measure", "study.tradeoff"):
        monkeypatch.setattr(f"dyngs.{module}.select_device", lambda _: GPU)
    there = replace(briefly, out=tmp_path / "there")
    with pretend_gpu():
        measured = there.run()
    untimed = [replace(x, ms=None, gain=1.0) for x in measured.values()]
    assert untimed == [replace(x, ms=None, gain=1.0) for x in expected.values()]
    monkeypatch.undo()
    with pytest.raises(DyngsError, match=r"another study .device:"):
        there.run()


def test_the_folder_of_a_variant_is_drawn_as_it_was_measured(found: Found, study: Tradeoff) -> None:
    variant = Variant(prune=0.5, mask_times=3, storage=2.0, alpha_min=0.02)
    folder = study.folder(variant)
    assert has_only_scene_file(folder)
    scene = load_run(folder).scene
    assert len(scene) == found[Variant()].gaussians / 2
    assert scene.masks is not None
    assert scene.options.alpha_min == 0.02
    for single in (Variant(sh_degree=0), Variant(alpha_min=0.02), Variant(storage=2.0)):
        folder = study.folder(single)
        assert evaluate_run(folder, "test", threads=1).psnr == pytest.approx(found[single].psnr)


def test_masks_that_a_run_has_stay(found: Found, study: Tradeoff, tmp_path: Path) -> None:
    run = study.out / "training" / Variant(mask_times=3, finetune=2).slug
    masked = replace(study, run_dir=run, out=tmp_path)
    assert current_settings(run)["mask_times"] == 3
    for variant in (Variant(prune=0.5), Variant(prune=0.5, finetune=1)):
        scene = load_run(masked.folder(variant)).scene
        assert scene.masks is not None
        assert len(scene.masks.times) == 3


def test_a_stored_run_cannot_be_varied(found: Found, study: Tradeoff) -> None:
    with pytest.raises(DyngsError, match=r"contains only scene\.dyngs; use the run that it"):
        current_settings(study.folder(Variant(storage=2.0)))


def test_the_error_of_a_damaged_point_names_the_remedy(found: Found, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    good = json.loads(json.dumps(asdict(found[Variant()])))
    path.write_text(json.dumps(good))
    assert read_measurement(path) == found[Variant()]
    bad = [json.dumps(good | {"psnr": value}) for value in ([1], "x", None)]
    bad += [json.dumps(good | {"ms": value}) for value in (0, float("nan"), float("inf"))]
    for text in (*bad, "", "[]", "{}", "[" * 5000):
        path.write_text(text)
        with pytest.raises(DyngsError, match=r"x\.json: .* not a result of a study; remove it"):
            read_measurement(path)


# Variants

VARIANTS = st.builds(
    Variant,
    prune=st.sampled_from([0.0, 0.5, 0.7]),
    mask_times=st.sampled_from([0, 6]),
    finetune=st.sampled_from([0, 9]),
    sh_degree=st.sampled_from([None, 0, 1]),
    storage=st.sampled_from([None, "auto", 1.0]),
    alpha_min=st.sampled_from([None, 0.01]),
)
OWN = {"prune": 0.0, "sh_degree": 2, "storage": None, "alpha_min": 0.004, "mask_times": 6}


@given(VARIANTS, VARIANTS)
def test_names_tell_variants_apart_and_merging_keeps_changes(a: Variant, b: Variant) -> None:
    assert (a.slug == b.slug) == (a == b)
    assert not {"/", " "} & set(a.slug)
    merged = replace(a, **b.changes)
    assert merged.changes == a.changes | b.changes
    assert replace(Variant(), **a.changes) == a


def test_the_setting_of_a_variant() -> None:
    assert (Variant().setting, Variant().name) == ("", "original")
    assert Variant(prune=0.5, finetune=9).setting == "prune + finetune"
    assert Variant(prune=0.5, sh_degree=0).setting == "several"


def test_single_changes_differ_from_the_run() -> None:
    names = [v.name for v in single_setting_variants(parse_variations([]), OWN, 0)]
    assert len(names) == len(set(names))
    assert {"sh_degree=0", "sh_degree=1", "mask_times=16", "prune=0.3"} <= set(names)
    assert not {"sh_degree=2", "mask_times=6"} & set(names)
    still = {"sh_degree": 0, "storage": None}
    fewer = [v.name for v in single_setting_variants(parse_variations([]), still, 0)]
    assert fewer == ["storage=auto", "storage=1", "storage=3"]
    tuned = single_setting_variants(parse_variations(["prune=0.5", "sh_degree=0"]), OWN, 7)
    assert tuned == [Variant(prune=0.5), Variant(prune=0.5, finetune=7), Variant(sh_degree=0)]


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("prun", "unknown setting; use prune, mask_times, sh_degree"),
        ("prune=1.5", "--vary prune=1.5: Input should be less than 1"),
        ("prune=", "valid number"),
        ("prune=nan", "finite number"),
        ("mask_times=2.5", "valid integer"),
        ("storage=fine", "--vary storage=fine"),
    ],
)
def test_unknown_variations_are_refused(word: str, message: str) -> None:
    with pytest.raises(DyngsError, match=message):
        parse_variations([word])


# The front and combinations

GOALS = st.lists(st.tuples(*[st.integers(0, 5)] * 3), min_size=1, max_size=12)


def measured(psnr: float, gain: float = 1.0, mb: float = 8.0) -> Measurement:
    return Measurement(
        "x", 4, psnr, 0.9, None, None, None, 100, mb, 1, 1.0, ms=10 / gain, gain=gain
    )


BASE = measured(30.0)


@given(GOALS)
def test_every_point_is_on_the_front_or_beaten_by_one_that_is(goals: list[tuple[int, ...]]) -> None:
    best = pareto_mask(goals)
    front = [goal for goal, is_best in zip(goals, best, strict=True) if is_best]
    assert front
    for goal, is_best in zip(goals, best, strict=True):
        beaten = any(
            other != goal and all(x >= y for x, y in zip(other, goal, strict=True))
            for other in front
        )
        assert beaten != is_best


def test_speed_size_and_quality_count() -> None:
    points = [BASE, measured(29.0, 2.0, 4.0), measured(28.0, 2.0, 8.0)]
    assert [row["on_front"] for row in build_rows(points)] == [True, True, False]


def test_cheapest_variants_are_combined_first() -> None:
    singles = {
        Variant(): BASE,
        Variant(prune=0.3): measured(28.0, 1.5),
        Variant(prune=0.5): measured(29.0, 2.0, 4.0),
        Variant(prune=0.75): measured(26.0, 4.0, 2.0),
        Variant(storage="auto"): measured(29.9, 1.0, 1.0),
        Variant(alpha_min=0.01): measured(29.8, 1.5),
        Variant(sh_degree=0): measured(20.0, 4.0),  # loses too much to be combined
    }
    together = combinations(singles, 9)
    first, second = Variant(prune=0.5, alpha_min=0.01), Variant(prune=0.75, alpha_min=0.01)
    assert together.index(first) < together.index(second)
    assert Variant(prune=0.5, storage="auto") in together
    assert all(len(v.settings) > 1 and v.sh_degree is None for v in together)
    # a weaker value never replaces a stronger one
    assert all(v.prune != 0.3 for v in together)
    assert len(set(together)) == len(together)
    assert combinations(singles, 0) == []
