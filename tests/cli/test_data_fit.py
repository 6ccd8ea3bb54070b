"""``dyngs data fit``: what it prints, writes and refuses."""

import json
from pathlib import Path

import pytest
from tiny_captures import write_colmap

from dyngs.cli import main
from dyngs.human.avatar import pose_fit
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture

pytestmark = pytest.mark.usefixtures("short_fits")

PrintedOutput = pytest.CaptureFixture[str]


def test_a_fitted_capture_says_how_good_it_is(tmp_path: Path, capsys: PrintedOutput) -> None:
    options = HumanOptions(size=48, num_frames=2, num_new=0, num_cameras=5, num_test=1, samples=1)
    root = write_human_capture(tmp_path / "person", options)
    assert main(["data", "fit", str(root), str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "2 frames; overlap of silhouettes (IoU) on 2 views left out of the fit" in printed
    assert "taken: the poses as given" in printed, "they are exact"
    assert f"next: dyngs train human data.root={tmp_path / 'out'}" in printed
    report = json.loads((tmp_path / "out" / "fit_report.json").read_text())
    assert report["taken"] == "the poses as given"
    assert set(report["iou_per_frame"]) == {"0", "1"}
    body = str(tmp_path / "out" / "body_train.npz")
    assert main(["data", "motion", body, str(tmp_path / "moves.npz")]) == 0, "a fit is a motion, too"
    assert "2 frames" in capsys.readouterr().out


def test_the_run_of_a_known_person_finds_poses_by_its_avatar(
    tmp_path: Path, capsys: PrintedOutput, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_fit, "MOST_WINDOWS", 1)
    options = HumanOptions(size=32, num_frames=1, num_new=0, num_cameras=3, num_test=1, samples=1)
    root, fitted, run = write_human_capture(tmp_path / "person", options), tmp_path / "fitted", tmp_path / "run"
    assert main(["data", "fit", str(root), str(fitted)]) == 0
    small = ["model.resolution=24", "train.steps=1", "run.threads=1"]
    assert main(["train", "human", f"data.root={fitted}", f"run.dir={run}", *small]) == 0
    assert main(["data", "fit", str(root), str(tmp_path / "new"), "--person", str(run)]) == 0
    assert "poses by the silhouette of the person's avatar: " in capsys.readouterr().out
    report = json.loads((tmp_path / "new" / "fit_report.json").read_text())
    assert [clip["views_left_out"] for clip in report["by_avatar"]] == [1]
    assert main(["data", "fit", str(root), str(tmp_path / "again"), "--person", str(fitted)]) == 0
    assert "avatar" not in capsys.readouterr().out, "a capture has none"


def test_what_cannot_be_fitted_is_refused_in_one_line(tmp_path: Path, capsys: PrintedOutput) -> None:
    write_colmap(tmp_path / "scene")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    for words, wanted in (
        ([str(tmp_path / "nothing"), str(tmp_path / "out")], "no such folder"),
        ([str(tmp_path / "scene"), str(tmp_path / "full")], "exists already"),
        ([str(tmp_path / "scene"), str(tmp_path / "out")], "give masks of the person"),
    ):
        assert main(["data", "fit", *words]) == 2
        error = capsys.readouterr().err.strip().splitlines()
        assert len(error) == 1
        assert wanted in error[0]
    assert not (tmp_path / "out").exists()


def test_a_body_of_another_template_is_never_fitted(tmp_path: Path, capsys: PrintedOutput) -> None:
    keys = [f"data.root={tmp_path / 'ann'}", "model.body=smplx.npz", f"run.dir={tmp_path / 'run'}"]
    write_human_capture(tmp_path / "ann", HumanOptions(size=16, num_frames=1, num_new=0, num_cameras=1, num_test=1))
    assert main(["train", "human", *keys]) == 2
    said = capsys.readouterr()
    assert "smplx.npz" in said.err
    assert "fitted" not in said.out
