"""``dyngs export`` of all that moves, cameras, pages and people with their skeleton, from the
command line."""

from __future__ import annotations

import argparse
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from bare_person import bare_run, bare_scene
from gltf_skins import SkinnedGlb
from moving_scene import moved_x, write_moving_run
from refused import error_line

import dyngs
from dyngs.api.train import train
from dyngs.cli import export, main
from dyngs.config import DataConfig
from dyngs.data.geometry import camera_center
from dyngs.data.read import read_capture
from dyngs.human.avatar.avatar_file import write_avatar
from dyngs.human.motion.amass import write_amass
from dyngs.human.motion.motion import Motion
from dyngs.io.formats.formats import read_splats


def run_of(still: Path, folder: Path, refine: str) -> Path:
    keys = [
        f"data.root={still}",
        f"run.dir={folder}",
        "train.steps=30",
        "init.num_random=60",
        "run.threads=1",
    ]
    return train(dyngs.load_config("static", [*keys, f"camera.refine={refine}"]))


@pytest.fixture(scope="module")
def refined(still: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_of(still, tmp_path_factory.mktemp("runs") / "refined", "always")


def test_refined_cameras_are_a_capture_of_their_own(
    refined: Path, still: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(refined), "--format", "cameras"]) == 0
    said = capsys.readouterr()
    assert f"written: {refined / 'cameras' / 'transforms.json'}" in said.out
    assert "refined training cameras" in said.err + said.out
    given = read_capture(still).splits
    found = read_capture(DataConfig(root=refined / "cameras", follow_links=True)).splits
    for moves in (True, False):
        split = "train" if moves else "test"
        there = {
            view.image_path.resolve(): camera_center(view.cam_from_world) for view in found[split]
        }
        shifts = [
            np.abs(there[v.image_path.resolve()] - camera_center(v.cam_from_world)).max()
            for v in given[split]
        ]
        assert bool(max(shifts) > 1e-6) is moves


def test_cameras_of_a_run_that_refined_none_are_those_of_the_capture(
    still: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_of(still, tmp_path / "run", "never")
    assert main(["export", str(run), "--out", str(tmp_path / "out" / "transforms.json")]) == 0
    said = capsys.readouterr()
    assert "the cameras of the capture" in said.err + said.out


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("--format cameras --time 0", "--time is not supported with"),
        ("--format cameras --static", "--static is not supported with"),
        ("--format cameras --out cameras.ply", "wrong suffix for --format cameras"),
    ],
)
def test_options_that_conflict_with_cameras_are_refused(
    words: str, part: str, refined: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(refined), *words.split()]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert part in lines[0]


def test_cameras_of_the_capture_are_not_written_over(
    refined: Path, still: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(refined), "--format", "cameras", "--out", str(still)]) == 2
    assert "exists, which is an input" in capsys.readouterr().err
    assert (
        main(
            ["export", str(refined), "--format", "cameras", "--out", str(still / "transforms.json")]
        )
        == 2
    )
    assert "override the cameras of the capture" in capsys.readouterr().err
    assert not (still / "transforms.json").exists()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_moving_run(tmp_path_factory.mktemp("moving"))


def test_a_page_is_written(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(run), "--out", str(tmp_path / "scene.html")]) == 0
    assert f"written: {tmp_path / 'scene.html'}" in capsys.readouterr().out
    assert (tmp_path / "scene.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert main(["export", str(run), "--format", "html"]) == 0
    assert (run / "scene.html").is_file()


def test_a_page_as_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    still = write_moving_run(tmp_path / "still", moves=False)
    assert (
        main(
            ["export", str(still), "--format", "html", "--folder", "--max-gaussians-drawn", "9000"]
        )
        == 0
    )
    assert sorted(path.name for path in (still / "scene").iterdir()) == [
        "0-0.bin",
        "dyngs-scene.js",
        "index.html",
    ]
    assert "python -m http.server -d" in capsys.readouterr().out
    assert main(["export", str(still), "--format", "html", "--folder"]) == 2
    assert "exists already" in capsys.readouterr().err


def test_sog_in_levels_is_a_folder(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["export", str(run), "--format", "sog", "--folder", "--out"]
    assert main([*words, str(tmp_path / "town"), "--time", "0.5"]) == 0
    assert (tmp_path / "town" / "lod-meta.json").is_file()
    assert f"written: {tmp_path / 'town'}" in capsys.readouterr().out
    for more, part in (("town.sog", "use --out FOLDER"), ("town", "exists already")):
        assert main([*words, str(tmp_path / more), "--time", "0.5"]) == 2
        assert part in capsys.readouterr().err
    assert main([*words, str(tmp_path / "several"), "--times", "0:1:3"]) == 2
    assert "--times and --folder write a folder" in capsys.readouterr().err
    assert not (tmp_path / "several").exists()


def test_a_page_has_the_full_name_of_its_run(run: Path, tmp_path: Path) -> None:
    dotted = shutil.copytree(run, tmp_path / "rc_0.2")
    assert main(["export", str(dotted), "--format", "html"]) == 0
    assert "<title>rc_0.2</title>" in (dotted / "scene.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("--format html --times 0:1:3", "--times is not supported with"),
        ("--format html --static", "--static is not supported with"),
        ("--format html --up y", "--up is not supported with"),
        ("--format html --sh-degree 3", "--sh-degree is not supported with"),
        ("--format html --max-change 3", "--max-change is not supported with --format html"),
        ("--format html --out page.pdf", "use --out page.html"),
        ("--format html --motion walk.bvh", "needs the run of a person"),
        ("--format html --folder --max-gaussians-drawn 9", "need a static scene"),
        ("--format html --folder --out page.html", "writes a folder; use --out page"),
        ("--format html --max-gaussians-drawn 9", "requires --folder"),
        ("--folder", "--folder is not supported with --format ply"),
    ],
)
def test_options_that_conflict_with_a_page_are_refused(
    words: str, part: str, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(run), *words.split()]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert part in lines[0]


def test_no_run_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(tmp_path / "none"), "--format", "html"]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = bare_run(bare_scene(resolution=24))
    path = tmp_path_factory.mktemp("person") / "ann.safetensors"
    return write_avatar(run.renderable, run.config.model, run.info, path)


@pytest.fixture(scope="module")
def motion(tmp_path_factory: pytest.TempPathFactory) -> Path:
    poses = 0.3 * torch.randn(3, 55, 3, generator=torch.Generator().manual_seed(0))
    path = tmp_path_factory.mktemp("motion") / "walk.npz"
    write_amass(Motion(poses, torch.zeros(3, 3), torch.zeros(10), 10.0, torch.ones(3)), path)
    return path


def test_a_mesh_that_walks(
    avatar: Path, motion: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "ann.glb"
    assert (
        main(
            ["export", str(avatar), "--format", "mesh", "--motion", str(motion), "--out", str(out)]
        )
        == 0
    )
    said = capsys.readouterr()
    assert f"written: {out}" in said.out
    assert "texture 96 x 96" in said.out + said.err
    found = SkinnedGlb(out)
    assert (found.json["animations"][0]["name"], found.num_frames) == ("walk", 3)
    assert abs(min(found.posed(frame)[:, 1].min() for frame in range(3))) < 1e-5


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--format mesh", r"ann\.safetensors: an output file is required; add --out FILE\.glb"),
        ("--format mesh --out x.ply", r"must be a .glb file; use --out x"),
        (
            "--format mesh --time 0 --out x.glb",
            "--time is not supported with --format mesh of a person",
        ),
        ("--format mesh --up y --out x.glb", "--up is not supported with --format mesh"),
        ("--format mesh --motion no.npz --out x.glb", r"error: no\.npz: "),
        (
            "--format mesh --cells 30 --out x.glb",
            "--cells is not supported with --format mesh of a person",
        ),
    ],
)
def test_wrong_options_end_in_one_line(
    avatar: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: str,
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", str(avatar), *options.split()]) == 2
    said = capsys.readouterr().err
    assert re.search(words, said)
    assert said.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def moving_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_moving_run(tmp_path_factory.mktemp("moving"), standing=True)


ROUNDING = 1e-7  # of float32, where weights of nodes add up to nearly 1


def test_export_of_a_moving_run(
    moving_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def export(*words: object) -> str:
        assert main(["export", str(moving_run), *[str(w) for w in words]]) == 0
        return capsys.readouterr().out

    def x_of(path: Path) -> list[float]:
        return read_splats(path).gaussians.means[:, 0].tolist()

    every = (0, 1, 2, 3, 4)
    moving = (1, 3)
    still = (0, 2, 4)
    assert "note: exporting time 0" in export()
    assert x_of(moving_run / "splats.ply") == pytest.approx(
        moved_x(every, 0.0).tolist(), abs=ROUNDING
    )
    assert "this is time" not in export("--time", 0.5, "--out", tmp_path / "middle.ply")
    assert x_of(tmp_path / "middle.ply") == pytest.approx(
        moved_x(every, 0.5).tolist(), abs=ROUNDING
    )
    assert "3 files" in export("--times", "0:1:3", "--out", tmp_path / "seq")
    assert x_of(tmp_path / "seq" / "frame_0002.ply") == pytest.approx(
        moved_x(every, 1.0).tolist(), abs=ROUNDING
    )
    export("--times", "0:1:3", "--dynamic")
    assert x_of(moving_run / "splats_dynamic" / "frame_0001.ply") == pytest.approx(
        moved_x(moving, 0.5).tolist(), abs=ROUNDING
    )
    for words, path in (
        (["--static"], moving_run / "splats_static.ply"),
        (["--static", "--times", "0:1:3", "--out", tmp_path / "still.ply"], tmp_path / "still.ply"),
        (
            ["--static", "--times", "0:1:3", "--out", tmp_path / "still"],
            tmp_path / "still" / "splats_static.ply",
        ),
    ):
        export(*words)
        assert x_of(path) == pytest.approx(moved_x(still, 0.0).tolist(), abs=ROUNDING)
    wrong = ["--times", "0:1:3", "--out", tmp_path / "a.ply"]
    assert "--times and --folder write a folder" in error_line(capsys, "export", moving_run, *wrong)


def test_export_of_tracks(
    moving_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(moving_run), "--format", "tracks"]) == 0
    assert "5 Gaussians, 2 of them moving, at 5 times" in capsys.readouterr().out
    with np.load(moving_run / "tracks.npz", allow_pickle=False) as stored:
        assert stored["times"].tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]
        assert stored["positions"].shape == (5, 5, 3)
    words = [
        "--format",
        "tracks",
        "--dynamic",
        "--times",
        "0:2:3",
        "--out",
        str(tmp_path / "t.npz"),
    ]
    assert main(["export", str(moving_run), *words]) == 0
    assert "clamped 1 of 3 times" in capsys.readouterr().err
    with np.load(tmp_path / "t.npz", allow_pickle=False) as stored:
        assert stored["positions"][:, 0, 0] == pytest.approx(
            moved_x((1, 3), 0.0).tolist(), abs=ROUNDING
        )
        assert stored["ids"].tolist() == [1, 3]


def test_export_accepts_every_suffix_that_its_help_names(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["export", "--help"]) == 0
    text = capsys.readouterr().out
    motions = re.search(r"motion file for a person: (.*?)--max", text, re.DOTALL)
    assert motions is not None
    others = {".kind", ".js", ".root", ".follow_links"}  # model.kind, three.js, data.root
    found = (
        set(re.findall(r"(?<=[a-z ])\.(?:4dgs|[a-z]\w+)", text.replace(motions[1], ""))) - others
    )
    assert {".ply", ".spz", ".4dgs", ".safetensors", ".html"} <= found
    for suffix in found:
        arguments = argparse.Namespace(
            out=Path(f"x{suffix}"), format=None, times=None, motion=None, time=None, bodies=False
        )
        assert export._kind(arguments)
