"""``dyngs export --format mesh`` and ``--joints``: files, notes, and wrong options in one line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from bare_person import bare_run, bare_scene
from gltf_skins import SkinnedGlb
from moving_scene import write_moving_run

from dyngs.cli import main
from dyngs.human.motion.amass import write_amass
from dyngs.human.motion.motion import Motion
from dyngs.runs.avatar import write_avatar


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_avatar(bare_run(bare_scene(resolution=24)), tmp_path_factory.mktemp("person") / "ann.safetensors")


@pytest.fixture(scope="module")
def motion(tmp_path_factory: pytest.TempPathFactory) -> Path:
    poses = 0.3 * torch.randn(3, 55, 3, generator=torch.Generator().manual_seed(0))
    path = tmp_path_factory.mktemp("motion") / "walk.npz"
    write_amass(Motion(poses, torch.zeros(3, 3), torch.zeros(10), 10.0, torch.ones(3)), path)
    return path


def test_a_mesh_that_walks(avatar: Path, motion: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "ann.glb"
    assert main(["export", str(avatar), "--format", "mesh", "--motion", str(motion), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert f"written: {out}" in said.out
    assert "texture of 96 x 96" in said.out + said.err
    found = SkinnedGlb(out)
    assert (found.json["animations"][0]["name"], found.num_frames) == ("walk", 3)
    assert abs(min(found.posed(frame)[:, 1].min() for frame in range(3))) < 1e-5


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_gaussians_with_joints(avatar: Path, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"ann{suffix}"
    assert main(["export", str(avatar), "--joints", "--out", str(out)]) == 0
    assert (b"property float weight_7" if suffix == ".ply" else b"JOINTS_1") in out.read_bytes()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--format mesh", r"ann\.safetensors: where to\? Give --out FILE\.glb"),
        ("--format mesh --out x.ply", "--format mesh does not write files of that suffix"),
        ("--format mesh --out .", r"--format mesh writes one file; give --out"),
        ("--format mesh --time 0 --out x.glb", "--time does not go with --format mesh"),
        ("--format mesh --up y --out x.glb", "--up does not go with --format mesh"),
        ("--format mesh --motion no.npz --out x.glb", r"no\.npz: no such file"),
        ("--format mesh --joints --out x.glb", "--joints goes with --format ply and glb, not with mesh"),
        ("--joints --out x.spz", "--joints goes with --format ply and glb, not with spz"),
        ("--joints --static --out x.ply", "--static does not go with --joints"),
        ("--joints --motion no.npz --out x.ply", "--motion does not go with --joints in a .ply"),
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


@pytest.mark.parametrize("options", [["--joints", "--out", "x.ply"], ["--format", "mesh"]])
def test_a_scene_without_a_person(tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str]) -> None:
    run = write_moving_run(tmp_path / "run")
    assert main(["export", str(run), *options]) == 2
    assert re.search(r"needs the run of a person \(model\.kind=human\), this one is", capsys.readouterr().err)
