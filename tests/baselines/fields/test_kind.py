"""Radiance fields by the commands: training, resuming, evaluation, rendering, mesh export, errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from small_fields import NERF, NGP, config_of

from dyngs.api.train import train
from dyngs.cli import main
from dyngs.evaluate.report import evaluate_run
from dyngs.runs.checkpoint import checkpoint_paths
from dyngs.runs.opened import open_run
from dyngs.view.layers import ViewRequest, draw
from dyngs.view.views import initial_viewpoint

STEPS = ["train.steps=30", "train.save_every=15"]


@pytest.fixture(scope="module")
def run(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "ngp"
    return train(config_of(capture, *NGP, *STEPS, f"run.dir={folder}"))


@pytest.mark.parametrize("keys", [NGP, NERF], ids=["ngp", "nerf"])
def test_resume_equals_uninterrupted_run(capture: Path, tmp_path: Path, keys: list[str]) -> None:
    run = train(config_of(capture, *keys, *STEPS, f"run.dir={tmp_path / 'run'}"))
    last = checkpoint_paths(run)[-1]
    whole = last.read_bytes()
    last.unlink()
    assert main(["train", "--resume", str(run)]) == 0
    assert last.read_bytes() == whole


def test_run_is_evaluated_rendered_and_viewed(run: Path, tmp_path: Path) -> None:
    report = evaluate_run(run)
    assert report.psnr > 11
    assert report.num_gaussians == 0
    assert main(["render", str(run), "--out", str(tmp_path / "images"), "--depth"]) == 0
    assert len(list((tmp_path / "images").rglob("*.png"))) > 1
    opened = open_run(run)
    for layer in ("colour", "depth"):
        shot = (
            ViewRequest(initial_viewpoint(opened).start)
            if layer == "colour"
            else ViewRequest(initial_viewpoint(opened).start, layer="depth")
        )
        assert draw(opened, shot).std() > 0


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".obj"])
def test_exported_surface_is_a_coloured_mesh(
    run: Path, tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dyngs.baselines.fields.scene.CELLS", 24)
    out = tmp_path / f"mesh{suffix}"
    assert main(["export", str(run), "--format", "mesh", "--level", "0.25", "--out", str(out)]) == 0
    mesh = trimesh.load(out, force="mesh", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    assert len(mesh.faces) > 10
    assert np.abs(mesh.vertices).max() < 1.5
    visual: Any = mesh.visual
    assert np.ptp(np.asarray(visual.vertex_colors)[:, :3]) > 0


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (["export", "RUN", "--out", "OUT/scene.ply"], "Gaussians"),
        (
            ["export", "RUN", "--format", "mesh", "--level", "1e9", "--out", "OUT/mesh.ply"],
            "another --level",
        ),
        (
            ["export", "RUN", "--format", "mesh", "--motion", "OUT/a.bvh", "--out", "OUT/mesh.ply"],
            "--motion",
        ),
        (["export", "RUN", "--format", "mesh", "--out", "OUT/mesh.stl"], ".ply"),
        (["prune", "RUN", "--out", "OUT/pruned"], "Gaussians"),
    ],
)
def test_invalid_arguments_are_refused(
    run: Path, tmp_path: Path, command: list[str], said: str, request: pytest.FixtureRequest
) -> None:
    request.getfixturevalue("monkeypatch").setattr("dyngs.baselines.fields.scene.CELLS", 24)
    capsys = request.getfixturevalue("capsys")
    (tmp_path / "a.bvh").touch()
    words = [word.replace("RUN", str(run)).replace("OUT", str(tmp_path)) for word in command]
    assert main(words) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        (["train.robust=always"], "not supported by model.kind=ngp"),
        (["train.exposure=always"], "not supported by model.kind=ngp"),
        (["camera.refine=always"], "not supported by model.kind=ngp"),
        (["budget.max_gaussians=10"], "not supported by model.kind=ngp"),
        (["model.time=true"], "model.time=true needs images at several times"),
        (["model.sizes=huge"], "one of tiny, cpu, published"),
    ],
)
def test_unsuitable_captures_are_refused(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], keys: list[str], said: str
) -> None:
    assert main(["train", f"data.root={capture}", f"run.dir={tmp_path / 'run'}", *NGP, *keys]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_one_camera_position_is_refused(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    meta = json.loads((capture / "transforms_train.json").read_text(encoding="utf-8"))
    one = tmp_path / "one"
    (one / "train").mkdir(parents=True)
    frame = meta["frames"][0]
    source = capture / f"{frame['file_path']}.png"
    for i in range(3):
        (one / "train" / f"{i}.png").write_bytes(source.read_bytes())
    meta["frames"] = [frame | {"file_path": f"./train/{i}"} for i in range(3)]
    (one / "transforms_train.json").write_text(json.dumps(meta), encoding="utf-8")
    assert main(["train", f"data.root={one}", f"run.dir={tmp_path / 'run'}", *NGP]) == 2
    assert "the same camera position" in capsys.readouterr().err
