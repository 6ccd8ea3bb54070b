"""Curved triangles by the commands: training, resuming, evaluation, rendering, export, errors."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from small_triangles import config_of

from dyngs.api.train import train
from dyngs.baselines.triangles.scene import SEGMENTS, TriangleScene
from dyngs.baselines.triangles.training import max_pixels
from dyngs.cli import main
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError
from dyngs.core.metrics import psnr
from dyngs.evaluate.report import evaluate_run
from dyngs.models.views import training_cameras
from dyngs.runs.checkpoint import checkpoint_paths
from dyngs.runs.opened import open_run

STEPS = ["train.steps=120", "train.save_every=60"]


@pytest.fixture(scope="module")
def run(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "triangles"
    return train(config_of(capture, *STEPS, "model.gaussian_steps=300", f"run.dir={folder}"))


def test_training_improves_and_respects_max_triangles(run: Path) -> None:
    assert evaluate_run(run).psnr > 18
    scene = open_run(run).renderable
    assert isinstance(scene, TriangleScene)
    assert 100 < len(scene.patches) <= 300
    assert scene.patches.texture == 3
    views = open_run(run).capture.splits["train"]
    assert max_pixels(scene, training_cameras(views, load_resolved(run).data)).min() >= 1


def test_resume_equals_uninterrupted_run(capture: Path, tmp_path: Path) -> None:
    # cut right after a change and the first texture
    steps = ["train.steps=112", "train.save_every=56"]
    run = train(config_of(capture, *steps, f"run.dir={tmp_path / 'run'}"))
    path = checkpoint_paths(run)[-1]
    whole = path.read_bytes()
    path.unlink()
    assert main(["train", "--resume", str(run)]) == 0
    assert path.read_bytes() == whole


def test_file_fits_requested_size(capture: Path, tmp_path: Path) -> None:
    """The limit is half the size of 72 values per triangle, so the run starts with fewer."""
    run = tmp_path / "run"
    keys = ["train.steps=60", "model.gaussian_steps=100", "model.max_triangles=1000"]
    train(config_of(capture, *keys, "budget.max_mb=0.0125", f"run.dir={run}"))
    file = run / "export" / "scene.dyngs"
    assert file.stat().st_size <= 12500
    whole, stored = (open_run(folder).renderable for folder in (run, file.parent))
    assert isinstance(whole, TriangleScene)
    assert isinstance(stored, TriangleScene)
    assert 100 <= len(stored.patches) == len(whole.patches) <= 12500 / (72 * 1.3)
    view = training_cameras(open_run(run).capture.splits["train"][:1], load_resolved(run).data)[0]
    assert psnr(stored.render(view).rgb, whole.render(view).rgb) > 30


def test_a_file_that_is_too_small_is_refused(capture: Path, tmp_path: Path) -> None:
    with pytest.raises(
        DyngsError, match=r"budget.max_mb=0.005 is too small for 100 triangles; 0.0098 would do"
    ):
        train(config_of(capture, "budget.max_mb=0.005", f"run.dir={tmp_path / 'run'}"))
    assert not (tmp_path / "run" / "config.yaml").exists()


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".obj"])
def test_export_is_a_coloured_mesh(run: Path, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"mesh{suffix}"
    assert main(["export", str(run), "--format", "mesh", "--out", str(out)]) == 0
    mesh = trimesh.load(out, force="mesh", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    scene = open_run(run).renderable
    assert isinstance(scene, TriangleScene)
    assert len(mesh.faces) == max(SEGMENTS, scene.patches.texture) ** 2 * len(scene.patches)
    visual: Any = mesh.visual
    assert np.ptp(np.asarray(visual.vertex_colors)[:, :3]) > 0


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (["export", "RUN", "--out", "OUT/scene.ply"], "Gaussians"),
        (
            ["export", "RUN", "--format", "mesh", "--level", "2", "--out", "OUT/mesh.ply"],
            "--level: not supported for the mesh",
        ),
        (["prune", "RUN", "--out", "OUT/pruned"], "Gaussians"),
        (
            ["train", "data.root=CAPTURE", "model.kind=bg_triangle", "budget.max_gaussians=5"],
            "not supported by model.kind=bg_triangle",
        ),
    ],
)
def test_invalid_arguments_are_refused(
    run: Path,
    capture: Path,
    tmp_path: Path,
    command: list[str],
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = " ".join(command)
    for name, folder in (("RUN", run), ("CAPTURE", capture), ("OUT", tmp_path)):
        words = words.replace(name, str(folder))
    assert main(words.split(" ")) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]


def test_coincident_points_are_refused(capture: Path, tmp_path: Path) -> None:
    same = tmp_path / "capture"
    shutil.copytree(capture, same)
    trimesh.PointCloud(np.zeros((20, 3))).export(same / "points3d.ply")
    more = ("model.gaussian_steps=0", f"run.dir={tmp_path / 'run'}")
    with pytest.raises(DyngsError, match="initial points coincide"):
        train(config_of(same, *more))


def test_a_capture_that_shows_no_surface_is_refused(
    capture: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Gaussians of empty images take hundreds of steps to become transparent."""
    monkeypatch.setattr("dyngs.baselines.triangles.training.fuse_depths", lambda *_: None)
    few = ["model.gaussian_steps=2", "run.dir=run"]
    assert main(["train", f"data.root={capture}", "model.kind=bg_triangle", *few]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert "no surface found after 2 steps of Gaussian training" in line
