"""``dyngs data`` motion, synth human and fit as a user calls them; the other commands are in other
tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from refused import error_line
from tiny_captures import write_colmap, write_image

from dyngs.cli import main
from dyngs.config import DataConfig
from dyngs.data.read import list_captures, read_capture
from dyngs.human.avatar import pose_fit
from dyngs.human.motion.amass import write_amass
from dyngs.human.motion.motion import Motion
from dyngs.human.motion.retarget import read_motion
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture

PrintedOutput = pytest.CaptureFixture[str]


def known_motion() -> Motion:
    """3 frames at 2 per second: two joints turn, a third stays turned; the root moves by 0.5 m,
    then by 0.1 m."""
    poses = torch.zeros(3, 55, 3)
    poses[:, 16, 2] = torch.tensor([0.0, 0.2, 0.4])
    poses[1, 15, 0] = 0.1
    poses[:, 17, 1] = 0.3
    trans = torch.tensor([[0.0, 1.0, 0.0], [0.3, 1.4, 0.0], [0.3, 1.4, 0.1]])
    return Motion(poses, trans, torch.zeros(10), 2.0, torch.ones(3))


def test_a_motion_is_converted_and_summed_up(tmp_path: Path, capsys: PrintedOutput) -> None:
    write_amass(known_motion(), tmp_path / "in.npz")
    out = tmp_path / "new" / "out.npz"
    assert main(["data", "motion", str(tmp_path / "in.npz"), str(out)]) == 0
    printed = capsys.readouterr().out
    for part in (
        str(out),
        "3 frames, 1.00 s at 2 frames per second",
    ):
        assert part in printed
    assert out.read_bytes() == (tmp_path / "in.npz").read_bytes(), (
        "what is of the template already stays as it is"
    )


def test_frames_per_second_and_the_up_axis_are_passed_on(
    tmp_path: Path, capsys: PrintedOutput
) -> None:
    """Five frames of three; what moved along the file's z moves along y, what moved along y away
    from z."""
    write_amass(known_motion(), tmp_path / "in.npz")
    words = ["--up", "z", "--fps", "4"]
    assert (
        main(["data", "motion", str(tmp_path / "in.npz"), str(tmp_path / "out.npz"), *words]) == 0
    )
    assert "5 frames, 1.00 s at 4 frames" in capsys.readouterr().out
    found = read_motion(tmp_path / "out.npz").trans
    np.testing.assert_allclose(found[2] - found[0], [0.3, 0.0, -0.4], atol=1e-6)
    np.testing.assert_allclose(found[4] - found[2], [0.0, 0.1, 0.0], atol=1e-6)


def test_a_motion_of_romp_without_a_rate_is_read_with_one_and_what_is_assumed_is_said(
    tmp_path: Path, capsys: PrintedOutput
) -> None:
    down = np.tile([np.pi, 0.0, 0.0], (4, 1))
    shapes = np.linspace([0.0], [0.6], 4) * np.ones(10)
    arrays = {
        "global_orient": down,
        "body_pose": np.zeros((4, 69)),
        "smpl_betas": shapes,
        "cam_trans": np.zeros((4, 3)),
    }
    np.savez(tmp_path / "romp.npz", **arrays)  # pyright: ignore[reportArgumentType]
    words = ["data", "motion", str(tmp_path / "romp.npz"), str(tmp_path / "out.npz")]
    assert main(words) == 2
    assert "romp.npz: has no frame rate;" in capsys.readouterr().err
    assert main([*words, "--fps", "20"]) == 0
    printed = capsys.readouterr().out
    assert "4 frames, 0.15 s at 20 frames per second" in printed
    notes = [line for line in printed.splitlines() if line.startswith("note: ")]
    assert len(notes) == 1
    assert "no up axis in the file; using -y" in notes[0]
    found = read_motion(tmp_path / "out.npz")
    assert float(found.poses.abs().max()) < 1e-6, "upright, in the axes of the template"


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("in.npz used.npz", "used.npz: already exists; give the name of a new file"),
        ("in.npz new.bvh", "new.bvh: motions are written as .npz"),
        ("nowhere.npz new.npz", "nowhere.npz: cannot be read (No such file"),
        ("in.txt new.npz", "in.txt: unknown motion format"),
        ("in.npz new.npz --clip walk", "remove the clip name 'walk'"),
        ("in.npz new.npz --fps 0", "frame rate 0 is outside"),
        ("in.npz new.npz --fps nan", "frame rate nan is outside"),
        ("in.npz new.npz --fps fast", "invalid float value: 'fast'"),
        ("in.npz new.npz --up x", "invalid choice: 'x'"),
        ("in.npz new.npz --body nowhere.npz", "nowhere.npz"),
        ("in.npz", "OUT.npz"),
    ],
)
def test_motion_is_refused_in_one_line(
    words: str, part: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: PrintedOutput
) -> None:
    monkeypatch.chdir(tmp_path)
    write_amass(known_motion(), Path("in.npz"))
    Path("used.npz").write_text("keep")
    assert main(["data", "motion", *words.split()]) != 0
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert part in lines[0]
    assert Path("used.npz").read_text() == "keep"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.npz", "used.npz"]


def test_an_unknown_format_is_answered_with_every_format(capsys: PrintedOutput) -> None:
    line = error_line(capsys, "data", "inspect", ".", "data.format=blendr")
    assert [
        name for name in get_args(DataConfig.model_fields["format"].annotation) if name not in line
    ] == []


def test_a_person_is_synthesised_and_inspected(tmp_path: Path, capsys: PrintedOutput) -> None:
    out = tmp_path / "new"
    words = ["--size", "12", "--views", "2", "--cameras", "3", "--seed", "4"]
    assert main(["data", "synth", "human", str(out), *words]) == 0
    assert f"dyngs train human {out}" in capsys.readouterr().out
    capture = read_capture(DataConfig(root=out))  # type: ignore[call-arg]
    assert {(view.frame, view.camera_id) for view in capture.splits["train"]} == {
        (f, c) for f in (0, 1) for c in range(3)
    }
    assert {(view.width, view.height) for view in capture.splits["train"]} == {(12, 12)}
    assert main(["data", "inspect", str(out), "data.format=body_json"]) == 0
    assert "body_json" in capsys.readouterr().out


def test_people_are_synthesised(tmp_path: Path, capsys: PrintedOutput) -> None:
    """Again with more of them: those are added. Options of one person, and other options than
    before, are refused."""
    out = tmp_path / "people"
    words = ["data", "synth", "people", str(out), "--size", "12", "--cameras", "3", "--people"]
    for count in (1, 2):
        assert main([*words, str(count)]) == 0
        assert f"dyngs train gps {out}" in capsys.readouterr().out
        people = list_captures(DataConfig(root=out))
        captures = [read_capture(person) for person in people]
        assert [sum(map(len, capture.splits.values())) for capture in captures] == [3] * count
    assert "other options" in error_line(capsys, *words, "2", "--seed", "5")
    assert "--people" in error_line(
        capsys, "data", "synth", "human", str(tmp_path / "x"), "--people", "2"
    )


@pytest.mark.parametrize(
    ("words", "part"),
    [("--views 0", "--views"), ("--cameras 0", "--cameras"), ("--seed -1", "--seed")],
)
def test_a_person_is_refused_in_one_line(
    words: str, part: str, tmp_path: Path, capsys: PrintedOutput
) -> None:
    assert main(["data", "synth", "human", str(tmp_path / "new"), *words.split()]) != 0
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert part in lines[0]
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("words", [["--matching", "sequential"], ["--masks", "masks"]])
def test_options_of_one_video_are_refused_for_several(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a.mp4", "b.mp4"):
        (tmp_path / name).write_bytes(b"")
    assert main(["data", "sfm", str(tmp_path), str(tmp_path / "out"), *words]) == 2
    assert "--matching and --masks are not supported for several videos" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("short_fits")
def test_a_fitted_capture_says_how_good_it_is(tmp_path: Path, capsys: PrintedOutput) -> None:
    options = HumanOptions(
        size=48, num_frames=2, num_pose_frames=0, num_cameras=5, num_test=1, samples=1
    )
    root = write_human_capture(tmp_path / "person", options)
    assert main(["data", "fit", str(root), str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "2 frames; silhouette IoU on 2 held-out views" in printed
    assert "chosen: given poses" in printed, "they are exact"
    assert f"next: dyngs train human {tmp_path / 'out'}" in printed
    report = json.loads((tmp_path / "out" / "fit_report.json").read_text())
    assert report["taken"] == "given poses"
    assert set(report["iou_per_frame"]) == {"0", "1"}
    body = str(tmp_path / "out" / "body_train.npz")
    assert main(["data", "motion", body, str(tmp_path / "moves.npz")]) == 0, (
        "a fit is a motion, too"
    )
    assert "2 frames" in capsys.readouterr().out


@pytest.mark.usefixtures("short_fits")
def test_the_run_of_a_known_person_finds_poses_by_its_avatar(
    tmp_path: Path, capsys: PrintedOutput, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_fit, "MAX_WINDOWS", 1)
    options = HumanOptions(
        size=32, num_frames=1, num_pose_frames=0, num_cameras=3, num_test=1, samples=1
    )
    root = write_human_capture(tmp_path / "person", options)
    fitted = tmp_path / "fitted"
    run = tmp_path / "run"
    assert main(["data", "fit", str(root), str(fitted)]) == 0
    small = ["model.resolution=24", "train.steps=1", "run.threads=1"]
    assert main(["train", "human", f"data.root={fitted}", f"run.dir={run}", *small]) == 0
    assert main(["data", "fit", str(root), str(tmp_path / "new"), "--person", str(run)]) == 0
    assert "poses fitted with the avatar: " in capsys.readouterr().out
    report = json.loads((tmp_path / "new" / "fit_report.json").read_text())
    assert [clip["views_left_out"] for clip in report["by_avatar"]] == [1]
    assert main(["data", "fit", str(root), str(tmp_path / "again"), "--person", str(fitted)]) == 0
    assert "avatar" not in capsys.readouterr().out, "a capture has none"


def test_what_cannot_be_fitted_is_refused_in_one_line(
    tmp_path: Path, capsys: PrintedOutput
) -> None:
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


@pytest.mark.usefixtures("short_fits")
def test_a_body_file_of_ones_own_is_fitted_trained_and_known_again(
    tmp_path: Path,
    capsys: PrintedOutput,
    monkeypatch: pytest.MonkeyPatch,
    smpl_files: tuple[Path, Path],
) -> None:
    monkeypatch.setattr(pose_fit, "MAX_WINDOWS", 1)
    options = HumanOptions(
        size=32, num_frames=1, num_pose_frames=0, num_cameras=3, num_test=1, samples=1
    )
    root = write_human_capture(tmp_path / "person", options)
    fitted = tmp_path / "fitted"
    run = tmp_path / "run"
    body, uv = map(str, smpl_files)
    assert main(["data", "fit", str(root), str(fitted), "--template", body, "--uv", uv]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("smpl (smpl.npz), 1 frame; silhouette IoU")
    keys = [f"model.body={body}", f"model.uv={uv}"]
    assert printed.splitlines()[-1] == f"next: dyngs train human {fitted} {' '.join(keys)}"
    small = ["model.resolution=24", "train.steps=1", "run.threads=1"]
    assert main(["train", "human", f"data.root={fitted}", f"run.dir={run}", *keys, *small]) == 0
    assert "fitted to the silhouettes" not in capsys.readouterr().out, "that was done"
    assert main(["data", "fit", str(root), str(tmp_path / "new"), "--person", str(run)]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("smpl (smpl.npz), 1 frame")
    assert "poses fitted with the avatar: " in printed
    with (
        np.load(fitted / "body_train.npz") as old,
        np.load(tmp_path / "new" / "body_train.npz") as new,
    ):
        assert np.array_equal(old["betas"], new["betas"])
        assert str(new["surface_model_type"]) == "smpl"
    assert main(["data", "fit", str(root), str(tmp_path / "other"), "--person", str(fitted)]) == 2
    assert (
        "was fitted with another template than anny; pass it with --template"
        in capsys.readouterr().err
    )
    assert (
        main(["data", "motion", str(fitted / "body_train.npz"), str(tmp_path / "moves.npz")]) == 0
    )


def test_a_body_file_that_cannot_be_fitted_is_refused_in_one_line(
    tmp_path: Path, capsys: PrintedOutput, smpl_files: tuple[Path, Path]
) -> None:
    root = tmp_path / "ann"
    write_human_capture(
        root, HumanOptions(size=16, num_frames=1, num_pose_frames=0, num_cameras=1, num_test=1)
    )
    body, uv = map(str, smpl_files)
    damaged = tmp_path / "damaged.npz"
    wrong = tmp_path / "wrong.obj"
    damaged.write_bytes(Path(body).read_bytes()[:5000])
    wrong.write_text("v 0 0 0\nvt 0 0\nf 1/1 1/1 1/1\n")
    for file, atlas, wanted in (
        (str(tmp_path / "none.npz"), uv, "none.npz: "),
        (str(damaged), uv, "damaged.npz: "),
        (body, None, "smpl.npz: has no UV map"),
        (body, str(wrong), "wrong.obj: cannot be read"),
        (None, uv, "requires --template"),
    ):
        out = tmp_path / "out"
        words = (["--template", file] if file else []) + (["--uv", atlas] if atlas else [])
        calls = [["data", "fit", str(root), str(out), *words]]
        if file is not None:
            keys = [f"model.body={file}"] + ([f"model.uv={atlas}"] if atlas else [])
            calls.append(["train", "human", f"data.root={root}", f"run.dir={out}", *keys])
        for call in calls:
            assert main(call) == 2
            said = capsys.readouterr()
            assert len(said.err.strip().splitlines()) == 1
            assert wanted in said.err
            assert "fitted" not in said.out
            assert sorted(path.name for path in tmp_path.iterdir()) == [
                "ann",
                "damaged.npz",
                "wrong.obj",
            ]


def test_photos_without_poses_are_inspected(tmp_path: Path, capsys: PrintedOutput) -> None:
    for i in range(3):
        write_image(tmp_path / f"{i}.png", np.zeros((6, 8, 3), np.uint8))
    assert main(["data", "inspect", str(tmp_path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["facts"]["photos"] == "3 without poses"
    assert found["facts"]["sizes"] == "8x6"
    assert f"dyngs train {tmp_path}" in found["facts"]["next"]
