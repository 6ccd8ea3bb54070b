"""A kind that is not made of Gaussians goes all the way: trained, resumed, evaluated, drawn,
viewed; not exported."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from toy_kind import ToyScene, registered

import dyngs
from dyngs.cli import main
from dyngs.config.io import load_config
from dyngs.core.errors import DyngsError
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import StillOptions, write_still_capture
from dyngs.evaluate.report import evaluate_run
from dyngs.export.choose_path import PathOptions, choose_path
from dyngs.export.images import OutputOptions, write_path_images, write_split_images
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.runs.opened import open_run
from dyngs.view.captured_views import viewpoint_of
from dyngs.view.layers import Shot, draw


@pytest.fixture(autouse=True, scope="module")
def toy() -> Iterator[None]:
    with registered():
        yield


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_still_capture(folder, StillOptions(size=24, num_train=6, num_test=2, samples=1))
    return folder


def options(capture: Path, run: Path) -> list[str]:
    steps = ["train.steps=40", "train.save_every=20", "train.eval_every=0"]
    return [f"data.root={capture}", f"run.dir={run}", "run.threads=1", "model.kind=toy", *steps]


@pytest.fixture(scope="module")
def run(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return dyngs.train(load_config(None, options(capture, tmp_path_factory.mktemp("runs") / "toy")))


def test_it_learns_and_resumes_with_the_same_bytes(
    run: Path, capture: Path, tmp_path: Path
) -> None:
    middle, last = checkpoint_paths(run)
    again = dyngs.train(load_config(None, options(capture, tmp_path / "again")))
    checkpoint_paths(again)[-1].unlink()
    assert [path.name for path in checkpoint_paths(again)] == [middle.name]
    assert main(["train", "--resume", str(again)]) == 0
    assert checkpoint_paths(again)[-1].read_bytes() == last.read_bytes()


def test_it_is_evaluated(run: Path) -> None:
    report = evaluate_run(run)
    assert report.psnr > 14, "a white image has 10 dB"
    assert (report.num_gaussians, report.num_moving) == (0, 0)
    assert report.model_mb == pytest.approx(4e-6 * 4 * 12**3)


def test_it_is_drawn_to_images_and_a_video(run: Path, tmp_path: Path) -> None:
    opened = open_run(run)
    output = OutputOptions(depth=True, video=tmp_path / "orbit.mp4")
    written = write_path_images(
        opened, choose_path(opened, PathOptions(num_frames=3)), tmp_path, output
    )
    assert len(written) == 3 * 3 + 1
    assert (tmp_path / "orbit.mp4").stat().st_size > 0
    assert len(write_split_images(opened, "test", tmp_path / "views")) > 0


def test_it_is_viewed(run: Path) -> None:
    opened = open_run(run)
    start = viewpoint_of(opened).start
    for shot in (Shot(start), Shot(start, layer="depth"), Shot(start, layer="error", view=0)):
        assert draw(opened, shot).std() > 0
    with pytest.raises(DyngsError, match="not made of Gaussians"):
        draw(opened, Shot(start, layer="motion"))


def test_it_is_loaded(run: Path, capture: Path) -> None:
    scene = load_run(run).renderable
    assert isinstance(scene, ToyScene)
    assert scene.is_static
    assert torch.equal(scene.to("cpu").grid, scene.grid)
    assert len(read_capture(capture).splits["train"]) == 6


@pytest.mark.parametrize(
    "command",
    [
        ["export", "RUN", "--out", "OUT/scene.ply"],
        ["prune", "RUN", "--out", "OUT/pruned"],
        ["tradeoff", "RUN", "--out", "OUT/trade"],
    ],
)
def test_what_needs_gaussians_refuses_it_in_a_line(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str]
) -> None:
    words = [word.replace("RUN", str(run)).replace("OUT", str(tmp_path)) for word in command]
    assert main(words) == 2
    said = capsys.readouterr().err.strip()
    assert "Gaussians" in said
    assert len(said.splitlines()) == 1
    assert not [
        path for path in tmp_path.rglob("*") if path.is_file() and "lock" not in path.name
    ], "nothing is half written"


def test_it_keeps_to_a_time(
    capture: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("dyngs.api.budget.time.FEWEST_STEPS", 5)  # whatever else the machine does
    run = tmp_path / "run"
    assert main(["train", *options(capture, run), "train.steps=100000", "train.minutes=0.04"]) == 0
    loaded = load_run(run)
    assert loaded.step == loaded.config.train.steps, "schedules end where the run ends"
    assert 5 <= loaded.step < 100_000
    assert 1 < loaded.seconds_train < 3
    assert "train.minutes: asked 0.04" in capsys.readouterr().out


def test_budgets_of_gaussians_are_refused(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for key in ("budget.max_gaussians=100", "budget.max_mb=1"):
        assert main(["train", *options(capture, tmp_path / "run"), key]) == 2
        assert key.partition("=")[0] in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
