"""``dyngs render``: splits, paths, times, videos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from moving_scene import write_moving_run
from refused import error_line

import dyngs
from dyngs.api.train import train
from dyngs.cli import main
from dyngs.data.images.images import read_image

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def run_dir(still: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    keys = [
        f"data.root={still}",
        f"run.dir={tmp_path_factory.mktemp('runs') / 'run'}",
        "train.steps=20",
        "run.threads=1",
    ]
    return train(dyngs.load_config("static", [*keys, "init.num_random=200"]))


@pytest.fixture(scope="module")
def moving_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_moving_run(tmp_path_factory.mktemp("moving"), standing=True)


def test_render_of_a_split(run_dir: Path, tmp_path: Path, capsys: Capture) -> None:
    assert (
        main(["render", str(run_dir), "--out", str(tmp_path / "test"), "--alpha", "--depth"]) == 0
    )
    names = {f.name for f in (tmp_path / "test").iterdir()}
    assert "sheet.png" in names
    assert any(n.endswith("_alpha.png") for n in names)
    assert any(n.endswith("_depth.exr") for n in names)
    assert "sheet.png" in capsys.readouterr().out
    assert "--size requires --path" in error_line(
        capsys, "render", run_dir, "--out", tmp_path, "--size", "8x8"
    )


def test_the_views_of_a_split_before_another_background(run_dir: Path, tmp_path: Path) -> None:
    """A corner that nothing covers has it in the render, in the truth of the sheet, and in the
    video."""

    def images(name: str, *words: str) -> dict[str, np.ndarray]:
        out = tmp_path / name
        assert main(["render", str(run_dir), "--split", "test", "--out", str(out), *words]) == 0
        return {f.name: read_image(f).numpy() for f in out.glob("*.png")}

    own = images("own")
    white = images("white", "--background", "white")
    black = images("black", "--background", "black")
    first = min(own.keys() - {"sheet.png"})
    assert all((own[name] == white[name]).all() for name in own)
    assert (white[first][0, 0] == 255).all()
    assert (black[first][0, 0] == 0).all()
    assert black["sheet.png"].mean() < white["sheet.png"].mean() - 20


def test_render_of_a_path_with_a_video(run_dir: Path, tmp_path: Path) -> None:
    pytest.importorskip("av")
    video = tmp_path / "orbit.mp4"
    words = [
        "--path",
        "orbit",
        "--frames",
        "3",
        "--size",
        "32x16",
        "--background",
        "black",
        "--video",
        str(video),
    ]
    assert main(["render", str(run_dir), "--out", str(tmp_path / "frames"), *words]) == 0
    assert len(list((tmp_path / "frames").glob("*.png"))) == 3
    assert video.stat().st_size > 0


def test_render_at_times(moving_run: Path, tmp_path: Path, capsys: Capture) -> None:
    def images(name: str, *words: str) -> int:
        assert main(["render", str(moving_run), "--out", str(tmp_path / name), *words]) == 0
        return len(list((tmp_path / name).glob("*.png")))

    assert images("orbit", "--path", "orbit", "--frames", "3") == 3
    assert "note: scene time runs from 0 to 1 along the path" in capsys.readouterr().out
    assert images("frozen", "--path", "orbit", "--frames", "3", "--time", "0.5") == 3
    assert images("together", "--path", "spiral", "--times", "0:1:4") == 4
    assert images("one", "--time", "0.5") == 1
    assert (
        images(
            "many", "--times", "0:1:4", "--view", "r_001", "--size", "8x8", "--background", "black"
        )
        == 4
    )
    assert images("view", "--view", "1", "--split", "train") == 1
    assert capsys.readouterr().err == ""
    assert images("clamped", "--time", "7") == 1
    assert "clamped 1 of 1 times to [0, 1]" in capsys.readouterr().out
    few = ("--max-gaussians-drawn", 9, "--view", 0)
    assert "need a static scene" in error_line(
        capsys, "render", moving_run, "--out", tmp_path, *few
    )
    assert "unknown view 'r_9'" in error_line(
        capsys, "render", moving_run, "--out", tmp_path, "--view", "r_9"
    )
    assert "not a range of times" in error_line(
        capsys, "render", moving_run, "--out", tmp_path, "--times", "x"
    )
    assert "'val' has no views" in error_line(
        capsys, "render", moving_run, "--out", tmp_path, "--split", "val", "--time", "0"
    )


def test_a_video_of_a_camera_that_stands_needs_no_folder(moving_run: Path, tmp_path: Path) -> None:
    pytest.importorskip("av")
    assert (
        main(["render", str(moving_run), "--times", "0:1:3", "--video", str(tmp_path / "a.mp4")])
        == 0
    )
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_times_where_nothing_moves(run_dir: Path, tmp_path: Path, capsys: Capture) -> None:
    assert main(["render", str(run_dir), "--out", str(tmp_path / "a"), "--time", "0.5"]) == 0
    assert "note: static scene: --time and --times have no effect" in capsys.readouterr().out
    ply = tmp_path / "splats.ply"
    assert main(["export", str(run_dir), "--out", str(ply), "--time", "0.5"]) == 0
    assert "note: the scene is static" in capsys.readouterr().out
    for words in (["--time", "0"], ["--times", "0:1:2"], ["--view", "0"]):
        assert "has no times and no views" in error_line(
            capsys, "render", ply, "--out", tmp_path, *words
        )
    for words in (["--dynamic"], ["--dynamic", "--format", "tracks"]):
        assert "nothing moves in this run" in error_line(capsys, "export", run_dir, *words)
