"""``dyngs edit``: words that begin with a minus, lines about what was done, and about each thing
that is refused."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from moving_scene import write_moving_run
from refused import error_line
from splat_scenes import cloud

from dyngs.cli import main
from dyngs.io.formats.formats import read_splats, write_splats
from dyngs.io.formats.splat_file import SplatFile

Capture = pytest.CaptureFixture[str]
LINE = "0,0,0,1,1,1\n1,0,0,2,1,1\n2,0,0,3,1,1\n"


@pytest.fixture
def plain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return write_splats(Path("plain.ply"), SplatFile(cloud(400, 1), up="-y")).path


def edit(*words: str) -> int:
    return main(["edit", *words])


def test_options_one_after_another(plain: Path, capsys: Capture) -> None:
    words = [
        "--crop",
        "-1,-1,-1",
        "1,1,1",
        "--merge",
        "plain.ply",
        "--origin",
        "-1,0,0",
        "--scale",
        "0,0,0 -1,0,0 2m",
    ]
    assert edit("plain.ply", *words, "--up", "-z", "--clean", "--out", "a.ply") == 0
    said = capsys.readouterr().out
    for line in (
        "needles",
        "without the cameras of a run",
        "crop: ",
        "plain.ply: 400 Gaussians added",
        "up axis of the output: -y",
    ):
        assert line in said
    assert "next:    dyngs view a.ply" in said
    assert len(read_splats("a.ply").gaussians) > 400
    assert edit("a.ply", "--crop", "0,0,0", "1.5", "--outside", "--out", "b.spz") == 0
    assert "spz cannot store the edits" in capsys.readouterr().out
    assert edit("a.ply", "--undo", "--out=c.ply") == 0
    assert len(read_splats("c.ply").gaussians) == len(read_splats("a.ply").gaussians)


def test_a_run_by_its_cameras(tmp_path: Path, capsys: Capture) -> None:
    run = tmp_path / "small"
    trained = write_moving_run(tmp_path, moves=False)
    assert main(["export", str(trained), "--format", "dyngs", "--out", str(run)]) == 0
    out = tmp_path / "a.ply"
    assert (
        edit(
            str(run / "scene.dyngs"),
            "--up",
            "auto",
            "--clean",
            "--max-loss",
            "0.2",
            "--threads",
            "1",
            "--out",
            str(out),
        )
        == 0
    )
    assert "dB lost, with training views" in capsys.readouterr().out
    assert edit(str(trained), "--out", str(out)) == 0
    os.rename(tmp_path / "capture", tmp_path / "moved")
    said = error_line(capsys, "edit", str(run), "--clean", "--out", str(out))
    assert "data.root=FOLDER" in said
    assert edit(str(run), "--clean", "--out", str(out), f"data.root={tmp_path / 'moved'}") == 0


def test_what_is_refused(plain: Path, capsys: Capture) -> None:
    """In one line, with nothing written and nothing changed."""
    Path("line.csv").write_text(LINE)
    Path("half.ply").write_bytes(plain.read_bytes()[:4000])
    Path("none.ply").write_bytes(plain.read_bytes().replace(b"vertex 400", b"vertex 0"))
    before = {path: path.read_bytes() for path in Path().iterdir()}
    refused = [
        (["--out", "a.xyz"], "edits end in a file of Gaussians"),
        (["--out", "plain.ply"], "exists, which is an input"),
        (["--merge", "half.ply", "--out", "half.ply"], "exists, which is an input"),
        (["--geo", "line.csv", "--out", "line.csv"], "exists, which is an input"),
        (["--crop", "open.obj"], "use two corners"),
        (["--crop", "50,50,50", "1"], "--crop leaves none"),
        (["--crop", "-1,0,0"], "use two corners"),
        (["--scale", "0"], "--scale: '0' is not a factor"),
        (["--scale", "-2"], "--scale: '-2' is not a factor"),
        (["--scale", "nan"], "--scale: 'nan' is not a number"),
        (["--geo", "line.csv"], "lie on one line"),
        (["--geo", "line.csv", "--up=y"], "--geo defines the whole coordinate frame; remove --up"),
        (["--undo", "--scale", "2"], "--undo defines the whole coordinate frame; remove --scale"),
        (["--undo"], "was not changed by"),
        (["--outside"], "--outside requires --crop"),
        (["--max-loss", "1"], "--max-loss requires --clean"),
        (["--clean", "--max-loss", "-1"], "--max-loss -1"),
        (["--up", "auto"], "--up auto needs the cameras of a run"),
        (["--merge", "half.ply"], "half.ply: cannot be read (ValueError: it is truncated"),
    ]
    for words, said in refused:
        out = [] if "--out" in words else ["--out", "a.ply"]
        assert said in error_line(capsys, "edit", "plain.ply", *words, *out), words
    assert "it is truncated" in error_line(capsys, "edit", "half.ply", "--out", "a.ply")
    assert "no Gaussians" in error_line(capsys, "edit", "none.ply", "--out", "a.ply")
    assert "no such file or folder" in error_line(capsys, "edit", "nothing", "--out", "a.ply")
    assert {path: path.read_bytes() for path in Path().iterdir()} == before
