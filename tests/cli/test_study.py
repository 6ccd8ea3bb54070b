"""``dyngs compare`` and ``dyngs tradeoff`` as a user calls them."""

from __future__ import annotations

import base64
import csv
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from moving_scene import write_moving_run
from PIL import Image
from refused import error_line
from toy_plugin import installed

from dyngs.api.budget import time as budget_time
from dyngs.cli import main
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.evaluate.report import evaluate_run
from dyngs.io.outputs import LOCK_NAME, lock_folder
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.study import compare
from dyngs.study.measure import TRUTH

pytestmark = pytest.mark.usefixtures("one_thread")
OPTIONS = ("--steps", "20", "--threads", "1", "init.num_random=100")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("captures") / "box"
    write_static_capture(folder, StaticOptions(size=16, num_train=6, num_test=3, samples=1))
    return folder


@pytest.fixture(scope="module")
def finished(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "comparison"
    assert (
        main(
            ["compare", str(capture), "--models", "static,mip,dynamic", *OPTIONS, "--out", str(out)]
        )
        == 0
    )
    return out


def test_a_table_curves_and_a_page(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = list(csv.DictReader((finished / "comparison.csv").read_text().splitlines()))
    assert {row["name"] for row in rows} == {"static", "mip"}
    assert all(
        float(row["psnr"]) > 5 and float(row["fps"]) > 0 and row["steps"] == "20" for row in rows
    )
    stored = json.loads((finished / "points" / "static.json").read_text())
    report = evaluate_run(finished / "runs" / "static", threads=1)
    assert (stored["psnr"], stored["ssim"]) == (report.psnr, report.ssim)
    assert stored["psnr_foreground"] == report.psnr_foreground
    assert stored["psnr_worst"] == min(view.psnr for view in report.per_view)
    assert "Skipped: dynamic: the images have no times" in (finished / "comparison.md").read_text()
    assert (finished / "comparison.svg").read_text().startswith("<svg")


def test_the_page_has_everything_in_it(finished: Path) -> None:
    text = (finished / "comparison.html").read_text()
    fetched: list[str] = []
    parser = HTMLParser()
    parser.handle_starttag = lambda tag, attrs: fetched.extend(  # type: ignore[method-assign]
        str(value) for name, value in attrs if name in ("src", "href")
    )
    parser.feed(text)
    assert fetched
    assert all(address.startswith("data:") for address in fetched)
    (views,) = re.findall(
        r'<script type="application/json" id="views">(.*?)</script>', text, re.DOTALL
    )
    shown = json.loads(views)
    assert [[model["name"] for model in view["models"]] for view in shown] == [
        ["static", "mip"]
    ] * 3
    png = base64.b64decode(shown[1]["truth"].partition(",")[2])
    assert png == (finished / "images" / TRUTH / "01.png").read_bytes()
    truth, model = (
        np.asarray(Image.open(finished / "images" / name / "01.png"), np.float64)
        for name in (TRUTH, "static")
    )
    assert 10 * np.log10(255**2 / ((truth - model) ** 2).mean()) == pytest.approx(
        shown[1]["models"][0]["psnr"], abs=0.2
    )


def test_the_same_command_trains_nothing(
    finished: Path,
    capture: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.delattr(compare, "train_to_end")
    words = [
        "compare",
        str(capture),
        "--models",
        "mip,static,dynamic",
        *OPTIONS,
        "--out",
        str(finished),
    ]
    capsys.readouterr()
    assert main([*words, "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert {row["name"] for row in values["rows"]} == {"static", "mip"}
    assert "dynamic" in values["left_out"]
    before = {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()}
    said = error_line(capsys, *words, "init.half_extent=2", "--split", "train")
    assert "split: test there, train here" in said
    assert (
        "overrides: init.num_random=100 there, init.num_random=100, init.half_extent=2 here" in said
    )
    assert {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()} == before


def test_a_stopped_study_resumes(
    finished: Path, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Resume a study that was killed during the second model, before the report."""
    out = tmp_path / "comparison"
    shutil.copytree(finished, out)
    (out / "points" / "mip.json").unlink()
    (out / "comparison.html").unlink()
    shutil.rmtree(out / "runs" / "mip")
    kept = checkpoint_paths(out / "runs" / "static")[-1].stat().st_mtime_ns
    note = json.loads((out / "study.json").read_text())
    (out / "study.json").write_text(json.dumps(note | {"settings": {}}))
    words = ["compare", str(capture), "--models", "static,mip,dynamic", *OPTIONS, "--out", str(out)]
    assert "settings" in error_line(capsys, *words), "a preset was changed meanwhile"
    (out / "study.json").unlink()
    assert main(words) == 0
    assert "mip: " in capsys.readouterr().out
    assert checkpoint_paths(out / "runs" / "static")[-1].stat().st_mtime_ns == kept
    again, first = (json.loads((f / "points" / "mip.json").read_text()) for f in (out, finished))
    assert (again["psnr"], again["steps"]) == (first["psnr"], first["steps"])
    assert (out / "comparison.html").is_file()


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("--models static --minutes 0", "argument --minutes: '0': must be a number above 0"),
        ("--models static --minutes nan", "must be a number above 0"),
        ("--models statik --steps 3", "statik: no such preset (did you mean 'static'?)"),
        ("--models static,static --steps 3", "two models are named static"),
        ("--models static", "a common limit is required: --minutes M, --steps N or --max-mb MB"),
        ("--models static --steps 3 --minutes 2", "not allowed with"),
        (
            "--models dynamic,human,human_predictor --steps 3",
            "none of the models can be trained on",
        ),
        ("--models static --steps 3 train.steps=9", "set by `dyngs compare`"),
        ("--models static --steps 3 --split val", "the split 'val' has no views"),
        ("--models static --steps 3 train.stesp=2", "did you mean 'train.steps'?"),
    ],
)
def test_wrong_usage_ends_in_one_line(
    words: str, part: str, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert part in error_line(capsys, "compare", str(capture), *words.split(), "--out", str(out))
    assert not out.exists()


def test_models_without_gaussians_take_part(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "grid.yaml"
    out = tmp_path / "out"
    own.write_text("model:\n  kind: toy\n")
    with installed():
        words = ["compare", str(capture), "--models", str(own), "--out", str(out)]
        assert "budget.max_mb=1" in error_line(capsys, *words, "--max-mb", "1")
        assert main([*words, "--steps", "20", "--threads", "1"]) == 0
    stored = json.loads((out / "points" / "grid.json").read_text())
    assert stored["steps"] == 20


def test_a_model_whose_images_were_shrunk_is_left_out(
    capture: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(budget_time, "SMALLEST_SIDE", 8)
    words = ["compare", str(capture), "--models", "static", "--minutes", "0.001", "--threads", "1"]
    assert main([*words, "init.num_random=100", "--out", str(tmp_path / "out")]) == 2
    said = (
        "static: too few steps fit into 0.001 minutes of training, "
        "so its images were resized to 8 px"
    )
    assert said in capsys.readouterr().err


def test_a_comparison_that_comes_to_nothing(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--models", "static", "--max-mb", "0.0001", "--out", str(tmp_path / "out")]
    assert main(["compare", str(capture), *words]) == 2
    assert (
        "no model could be trained; static: budget.max_mb=0.0001: too small for"
        in capsys.readouterr().err
    )


def test_to_the_same_size(capture: Path, tmp_path: Path) -> None:
    words = [
        "--models",
        "static",
        "--max-mb",
        "0.05",
        *OPTIONS[2:],
        "train.steps=20",
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(["compare", str(capture), *words]) == 0
    stored = json.loads((tmp_path / "out" / "points" / "static.json").read_text())
    file = tmp_path / "out" / "runs" / "static" / "export" / "scene.dyngs"
    assert stored["mb"] == pytest.approx(1e-6 * file.stat().st_size)
    assert 0 < stored["mb"] <= 0.05
    assert stored["seconds"] > 0


def test_a_table_and_the_folders_of_variants(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = str(write_moving_run(tmp_path))
    out = tmp_path / "out"
    vary = ("--vary", "alpha_min=0.02", "--vary", "storage=2")
    words = ["tradeoff", run, "--out", str(out), *vary, "--threads", "1"]
    assert main(words) == 0
    text = capsys.readouterr().out
    for word in ("original", "alpha_min=0.02", "tradeoff.csv", str(out / "models")):
        assert word in text
    assert max(len(line) for line in text.splitlines() if str(out) not in line) <= 100
    assert {f.name for f in out.iterdir()} >= {
        f"tradeoff.{suffix}" for suffix in ("csv", "json", "svg", "html", "md")
    }
    assert len(load_run(out / "models" / "storage-2.0").scene) == 5


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("nowhere", "nowhere: not a run folder"),
        (". --vary prun", "unknown setting"),
        (". --combine -1", "argument --combine"),
        (". ", "not a run folder"),
    ],
)
def test_wrong_usage_of_tradeoff_ends_in_one_line(
    words: str, part: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert part in error_line(capsys, "tradeoff", *words.split(), "--out", "x")
    assert list(Path().iterdir()) == []


def test_two_sweeps_do_not_mix(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_moving_run(tmp_path)
    out = tmp_path / "out"
    with lock_folder(out):
        assert main(["tradeoff", str(run), "--out", str(out), "--vary", "prune=0.5"]) == 2
        assert [path.name for path in out.iterdir()] == [LOCK_NAME]
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "has been writing there since" in told
