"""Evaluation: known scores, the report file, and what happens with nothing to evaluate."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from moving_scene import TEST_TIMES, sliding_nodes, write_moving_run

import dyngs
from dyngs.api.train import train
from dyngs.cli import main
from dyngs.cli.evaluate import report_rows
from dyngs.config import Config, DataConfig, TrainConfig
from dyngs.config.io import RESOLVED_NAME, load_resolved, save_config
from dyngs.core.errors import DyngsError
from dyngs.core.metrics import MetricValue
from dyngs.data.capture import Capture
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.evaluate.report import (
    evaluate_run,
    load_split_images,
    report_path,
    split_views,
)
from dyngs.gaussians import Gaussians
from dyngs.io.write import write_image
from dyngs.runs.checkpoint import (
    Checkpoint,
    CheckpointInfo,
    latest_checkpoint,
    load_run,
    save_checkpoint,
)


def some_gaussians(count: int = 12, degree: int = 0) -> Gaussians:
    random = torch.Generator().manual_seed(3)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=random) * 2 - 1

    sh = uniform(count, (degree + 1) ** 2, 3)
    return Gaussians(
        uniform(count, 3), uniform(count, 4), uniform(count, 3) * 0.3 - 1.5, uniform(count) + 1, sh
    )


def write_run(folder: Path, gaussians: Gaussians, background: str = "auto") -> Path:
    """A run folder with a 16x16 capture of 2 train and 3 test images beside it."""
    root = write_static_capture(
        folder / "capture", StaticOptions(size=16, num_train=2, num_test=3, samples=1)
    )
    run_dir = folder / "run"
    data = DataConfig.model_validate({"root": root, "background": background})
    config = Config(data=data, train=TrainConfig(steps=7))
    save_config(config, run_dir / RESOLVED_NAME)
    tensors = {f"gaussians.{name}": x for name, x in gaussians.tensors().items()}
    save_checkpoint(
        run_dir,
        Checkpoint(CheckpointInfo(7, 1.0, (0.0, 0.0, 0.0), "white", "classic"), tensors),
        12.5,
    )
    return run_dir


def test_report_of_a_run(tmp_path) -> None:
    gaussians = some_gaussians(degree=1)
    run_dir = write_run(tmp_path, gaussians)
    report = evaluate_run(run_dir)
    stored = json.loads((run_dir / "metrics.json").read_text())
    assert stored == json.loads(report.to_json())
    keys = (
        "split num_views width height background psnr ssim flip lpips lpips_net "
        "num_gaussians model_mb fps"
    )
    over_time = "num_moving moving_fraction field_mb deform_fraction psnr_per_time psnr_person"
    parts = "ssim_person psnr_foreground psnr_moving psnr_static moving_from"
    parts += " ssim_moving flip_moving flicker_static flicker_static_images"
    parts += " psnr_right psnr_right_fitted psnr_own_poses own_poses"
    parts += " silhouette_poses psnr_white psnr_black ssim_black lpips_black see_through flip_views"
    rest = {
        *parts.split(),
        "seconds_train",
        "step",
        "reasons",
        "notes",
        "per_view",
        "colour_floats",
        "stored_mb",
    }
    assert set(keys.split()) | set(over_time.split()) | rest == set(stored)
    facts = {
        "split": "test",
        "num_views": 3,
        "width": 16,
        "height": 16,
        "background": "white",
        "lpips_net": "alex",
    }
    facts |= {"num_gaussians": 12, "step": 7, "seconds_train": 12.5}
    assert {key: stored[key] for key in facts} == facts
    assert stored["model_mb"] == pytest.approx(12 * 4 * (3 + 4 + 3 + 1 + 12) / 1e6)
    assert stored["psnr"] == pytest.approx(sum(view["psnr"] for view in stored["per_view"]) / 3)
    assert stored["ssim"] == pytest.approx(sum(view["ssim"] for view in stored["per_view"]) / 3)
    optional = ("psnr_foreground", "psnr_moving", "psnr_static")
    for name in ("flip", "lpips", *optional):
        assert (stored[name] is None) == (name in stored["reasons"])
    assert stored["fps"] > 0
    assert 0 <= stored["deform_fraction"] < 1
    assert (stored["num_moving"], stored["moving_fraction"], stored["field_mb"]) == (0, 0, 0)
    assert stored["psnr_per_time"] == []
    assert {view["time"] for view in stored["per_view"]} == {None}
    assert len({view["name"] for view in stored["per_view"]}) == 3
    again = evaluate_run(run_dir)
    assert (again.psnr, again.ssim, again.flip) == (report.psnr, report.ssim, report.flip)


def test_psnr_is_that_on_the_background_of_the_run(tmp_path) -> None:
    """And the same number as on that colour; the scene is drawn once for both."""
    reports = {
        name: evaluate_run(write_run(tmp_path / name, some_gaussians(), name))
        for name in ("white", "black")
    }
    assert reports["white"].psnr == reports["white"].psnr_white
    assert reports["black"].psnr == reports["black"].psnr_black
    for name in ("psnr_white", "psnr_black"):
        on_white, on_black = (getattr(reports[x], name) for x in ("white", "black"))
        assert on_white == pytest.approx(on_black, abs=1e-4)
    assert reports["white"].psnr_white != pytest.approx(reports["white"].psnr_black, abs=0.1)


def test_see_through_objects_are_warned_of(tmp_path) -> None:
    report = evaluate_run(write_run(tmp_path, some_gaussians()))
    assert report.background == "white"
    (line,) = replace(report, see_through=0.05).warnings
    assert "5% of the object is see-through" in line
    assert "--background black" in line
    assert replace(report, see_through=0.001, psnr_white=30.0, psnr_black=34.0).warnings == ()
    assert replace(report, see_through=None).warnings == ()


def test_flip_of_large_images_is_computed_on_evenly_spaced_views(tmp_path, monkeypatch) -> None:
    run_dir = write_run(tmp_path, some_gaussians())
    monkeypatch.setattr("dyngs.evaluate.report.FLIP_PIXELS", 16 * 16 * 2)
    monkeypatch.setattr(
        "dyngs.evaluate.view_scores.flip", lambda rendered, truth, mask: MetricValue(0.25)
    )
    report = evaluate_run(run_dir)
    assert [view.flip for view in report.per_view] == [0.25, None, 0.25]
    assert (report.flip, report.flip_views) == (0.25, 2)
    assert ("FLIP of 2 views", "0.2500") in report_rows(report)


def test_the_table_lists_what_was_measured_and_more_with_verbose(tmp_path) -> None:
    report = evaluate_run(write_run(tmp_path, some_gaussians()))
    short = dict(report_rows(replace(report, flip=0.1, lpips=None, flip_views=3)))
    assert {"PSNR", "SSIM", "FLIP", "rendering", "training"} <= set(short)
    assert not {"LPIPS (alex)", "PSNR of right halves"} & set(short)
    assert short["training"] == "7 steps in 12 s"
    assert dict(report_rows(replace(report, seconds_train=0.0)))["training"] == "7 steps"
    more = dict(report_rows(report, verbose=True))
    assert "PSNR of right halves" in more
    worst = min(report.per_view, key=lambda view: view.psnr)
    assert more[f"PSNR of {worst.name}"] == f"{worst.psnr:.2f} dB"
    assert "the images have no times" in more.values()


def test_an_unfinished_run_is_reported_as_unfinished(tmp_path) -> None:
    run_dir = write_run(tmp_path, some_gaussians())
    config = load_resolved(run_dir)
    save_config(
        config.model_copy(update={"train": TrainConfig(steps=7000)}), run_dir / RESOLVED_NAME
    )
    (note,) = evaluate_run(run_dir).notes
    assert "unfinished run: step 7 of 7,000" in note
    assert json.loads((run_dir / "metrics.json").read_text())["notes"] == [note]


def test_other_splits_and_backgrounds(tmp_path) -> None:
    run_dir = write_run(tmp_path, some_gaussians(), background="random")
    report = evaluate_run(run_dir, "train", lpips_net="vgg", threads=1)
    assert report_path(run_dir, "train") == run_dir / "metrics_train.json"
    stored = json.loads((run_dir / "metrics_train.json").read_text())
    assert (stored["split"], stored["num_views"], stored["background"]) == ("train", 2, "black")
    assert report.notes == ("trained with random backgrounds, evaluated on black",)
    assert report.lpips_net == "vgg"
    assert not (run_dir / "metrics.json").exists()
    with pytest.raises(
        DyngsError,
        match=r"the split 'val' has no views; there is train \(2 views\), test \(3 views\)",
    ):
        evaluate_run(run_dir, "val")
    assert not (run_dir / "metrics_val.json").exists()


def test_capture_without_any_views(tmp_path) -> None:
    with pytest.raises(DyngsError, match="there is none"):
        split_views(Capture(tmp_path, "blender", {"train": ()}), "test")


def test_report_of_a_moving_run(tmp_path) -> None:
    run_dir = write_moving_run(tmp_path, standing=True)
    report = evaluate_run(run_dir)
    stored = json.loads((run_dir / "metrics.json").read_text())
    assert (report.num_gaussians, report.num_moving, report.moving_fraction) == (5, 2, 0.4)
    values = sliding_nodes().num_values
    assert report.field_mb == pytest.approx(4e-6 * values)
    assert report.model_mb == pytest.approx(4e-6 * (5 * 14 + values))
    assert [view.time for view in report.per_view] == list(TEST_TIMES)
    assert [(at["time"], at["num_views"]) for at in stored["psnr_per_time"]] == [
        (t, 1) for t in TEST_TIMES
    ]
    assert [at["psnr"] for at in stored["psnr_per_time"]] == [
        view["psnr"] for view in stored["per_view"]
    ]
    assert 0 < report.deform_fraction < 1
    assert report.notes == ()


def test_parts_of_a_moving_scene_are_measured(tmp_path, capsys) -> None:
    """With labels for each test image."""
    run_dir = write_moving_run(tmp_path)
    root = tmp_path / "capture"
    document = json.loads((root / "transforms_test.json").read_text())
    moves = np.zeros((16, 16), np.uint8)
    moves[4:12], moves[4:12, 8:] = 1, 2
    write_image(root / "moves.png", moves)
    for frame in document["frames"]:
        frame["instance_mask_path"] = "moves.png"
    (root / "transforms_test.json").write_text(json.dumps(document))
    report = evaluate_run(run_dir)
    assert report.psnr_foreground is not None
    assert report.psnr_foreground < report.psnr, "less white background"
    assert report.moving_from == "motion masks"
    assert report.psnr_moving is not None
    assert report.psnr_static is not None
    assert "psnr_foreground" not in report.reasons
    known = [view.psnr_foreground for view in report.per_view if view.psnr_foreground is not None]
    assert report.psnr_foreground == pytest.approx(sum(known) / len(known))
    assert main(["eval", str(run_dir), "--verbose"]) == 0
    shown = capsys.readouterr().out
    assert "on the foreground" in shown
    assert "on what moves" in shown


def test_still_models_of_moving_captures(tmp_path) -> None:
    report = evaluate_run(write_moving_run(tmp_path / "static", moves=False))
    assert (report.num_moving, report.notes) == (0, ())
    assert len(report.psnr_per_time) == len(TEST_TIMES)
    run_dir = write_moving_run(tmp_path / "dynamic", moves=False)
    config = (run_dir / RESOLVED_NAME).read_text().replace("kind: static", "kind: dynamic")
    (run_dir / RESOLVED_NAME).write_text(config)
    (note,) = evaluate_run(run_dir).notes
    assert "dynamic model without motion" in note


@pytest.fixture(scope="module", params=["always", "never"])
def run(
    request: pytest.FixtureRequest, still: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("runs") / request.param
    keys = [
        f"data.root={still}",
        f"run.dir={folder}",
        "train.steps=30",
        "init.num_random=60",
        "run.threads=1",
    ]
    return train(
        dyngs.load_config("static", [*keys, f"camera.refine={request.param}"])
    ), request.param


def test_the_second_figure_is_there_where_cameras_were_refined_or_it_is_asked_for(
    run: tuple[Path, str],
) -> None:
    folder, refine = run
    report = evaluate_run(folder)
    asked = evaluate_run(folder, refine_poses=True)
    assert (report.psnr_own_poses is not None) == (refine == "always")
    assert asked.psnr_own_poses is not None
    assert asked.psnr_own_poses > asked.psnr - 0.2  # its loss is not PSNR
    assert asked.psnr == report.psnr
    assert asked.own_poses is None, "nobody is in the images"
    assert evaluate_run(folder, "train").psnr_own_poses is None
    with pytest.raises(DyngsError, match="--refine needs images that were not trained on"):
        evaluate_run(folder, "train", refine_poses=True)


def test_training_images_have_the_refined_cameras(run: tuple[Path, str]) -> None:
    folder, refine = run
    loaded = load_run(folder)
    capture = read_capture(loaded.config.data)
    views = capture.splits["train"]
    refined = load_split_images(capture, views, folder, loaded)[0].cameras
    given = ImageLoader(views, loaded.config.data)[0].cameras
    moved = float((refined.cam_from_world - given.cam_from_world).abs().max())
    assert (moved > 0) == (refine == "always")
    if refine == "always":
        assert bool(latest_checkpoint(folder).part("cameras")["poses"].any())


def test_files_are_refused_in_one_line(tmp_path, capsys) -> None:
    file = tmp_path / "middle.ply"
    file.write_bytes(b"ply\n")
    assert main(["eval", str(file)]) == 2
    assert "holds no images to compare with" in capsys.readouterr().err
