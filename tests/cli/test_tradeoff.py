"""``dyngs tradeoff`` as a user calls it."""

from __future__ import annotations

from pathlib import Path

import pytest
from moving_scene import write_moving_run
from refused import error_line

from dyngs.cli import main
from dyngs.io.lock import LOCK_NAME, writing
from dyngs.runs.checkpoint import load_run

pytestmark = pytest.mark.usefixtures("one_thread")


def test_a_table_files_and_a_chosen_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """But for the memory, measured in processes that import the renderer:
    tests/study/tradeoff/test_sweep.py."""
    monkeypatch.setattr("dyngs.study.tradeoff.memory.MemoryMeter.peak_megabytes", lambda *_: None)
    run = str(write_moving_run(tmp_path))
    out = tmp_path / "out"
    words = [
        "tradeoff",
        run,
        "--out",
        str(out),
        "--vary",
        "scale=0.5",
        "--vary",
        "storage=2",
        "--rounds",
        "1",
    ]
    assert (
        main([*words, "--threads", "1", "--require", "fps>=0.001,mb<=1", "--minimize", "mb"]) == 0
    )
    text = capsys.readouterr().out
    for word in (
        "as it is",
        "scale=0.5",
        "storage=2",
        "each setting alone",
        "tradeoff.csv",
        "chosen:",
    ):
        assert word in text
    assert max(len(line) for line in text.splitlines() if str(out) not in line) <= 100
    assert {f.name for f in out.iterdir()} >= {
        f"tradeoff.{suffix}" for suffix in ("csv", "json", "svg", "html", "png")
    }
    (chosen,) = (out / "chosen").iterdir()
    assert len(load_run(chosen).scene) == 5
    error = error_line(capsys, *words, "--require", "mb<=0.000001", begun=True)
    assert "no measured variant has mb<=1e-06; mb<=1e-06 is too strict" in error


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("nowhere", "nowhere: no such preset"),
        ("nowhere", "nor is it the folder of a run"),
        ("static data.root=x", "give --out DIR"),
        (". --vary prun", "no such setting"),
        (". --require psnr>30", "is no condition"),
        (". --minimize size", "no such metric"),
        (". --rounds 0", "argument --rounds: '0' is not a number; write a whole number from 1"),
        (". ", "not a run folder"),
        (". --minimize mb --maximize psnr", "not allowed with"),
    ],
)
def test_wrong_usage_ends_in_one_line(
    words: str, part: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = [] if "static" in words else ["--out", "x"]
    assert part in error_line(capsys, "tradeoff", *words.split(), *out)
    assert list(Path().iterdir()) == []


def test_two_sweeps_do_not_mix(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_moving_run(tmp_path)
    out = tmp_path / "out"
    with writing(out):
        assert main(["tradeoff", str(run), "--out", str(out), "--vary", "scale=0.5"]) == 2
        assert [path.name for path in out.iterdir()] == [LOCK_NAME]
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "has been writing there since" in told
