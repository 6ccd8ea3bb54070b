"""Quality of short trainings, through what a user calls: PSNR of held-out views, motion, never
worse than static.

Floors are 0.3 dB below what was measured, which stands beside them: instruction sets differ by up
to 0.15 dB.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

import dyngs
from dyngs.api.train import train
from dyngs.cli import main
from dyngs.config.io import load_resolved
from dyngs.data.images.images import read_image
from dyngs.evaluate.report import EvalReport, evaluate_run
from dyngs.human.fit import fitted_capture
from dyngs.human.fit.capture_fit import FitEffort
from dyngs.io.write import write_image

SMALL = ("init.num_random=2000", "strategy.max_gaussians=6000")


@dataclass(frozen=True)
class Captured:
    """A synthetic capture, and a place for runs on it."""

    root: Path

    @staticmethod
    def of(folder: Path, *words: str) -> Captured:
        """The capture of ``dyngs data synth``."""
        assert main(["data", "synth", *words, str(folder / "capture")]) == 0
        return Captured(folder)

    def keys(self, name: str, *keys: str) -> list[str]:
        return [
            f"data.root={self.root / 'capture'}",
            f"run.dir={self.root / name}",
            "run.threads=1",
            *SMALL,
            *keys,
        ]

    def trained(self, preset: str, *keys: str) -> Path:
        return train(dyngs.load_config(preset, self.keys(preset, *keys)))

    def report(self, preset: str, *keys: str) -> EvalReport:
        return evaluate_run(self.trained(preset, *keys))


@pytest.fixture(scope="module")
def still_life(tmp_path_factory: pytest.TempPathFactory) -> Captured:
    return Captured.of(tmp_path_factory.mktemp("still"), "still", "--size", "64", "--views", "24")


def test_a_static_scene(still_life: Captured) -> None:
    assert still_life.report("static", "train.steps=400").psnr > 31.0  # 31.31


def test_a_white_object_is_solid_on_black(tmp_path: Path) -> None:
    """On white alone, nothing of it needs to be there."""
    captured = Captured.of(tmp_path, "still", "--size", "32", "--views", "12")
    for file in (tmp_path / "capture").rglob("*.png"):
        pixels = read_image(file).numpy().copy()
        pixels[..., :3] = 255
        write_image(file, pixels)
    report = captured.report("static", "train.steps=200")
    assert report.psnr == report.psnr_white
    assert report.psnr_white is not None
    assert report.psnr_black is not None
    assert report.psnr_black > 24.0  # 27.09; 4.92 with train.alpha_weight=0


def test_a_static_scene_by_mcmc(still_life: Captured) -> None:
    assert still_life.report("static_mcmc", "train.steps=400").psnr > 28.6  # 28.95


def test_a_scene_that_moves_beside_a_static_model_of_it(tmp_path: Path) -> None:
    """The scene ends moving, and is better than a static one.

    That learns at the same rates: its own, for so short a run, would favour it.
    """
    captured = Captured.of(tmp_path, "spin", "--size", "32", "--views", "32")
    keys = (
        "train.steps=800",
        "init.num_random=1000",
        "strategy.max_gaussians=1500",
        "train.initial_downscale=1",
    )
    moving = captured.report("dynamic", *keys, "model.pilot_runs=false", "optim.rate_factor=1")
    static = captured.report("static", *keys, "optim.rate_factor=1")
    assert moving.moving_fraction > 0.7  # 0.81
    assert moving.psnr > 23.5  # 24.44
    assert moving.psnr > static.psnr + 0.7  # 22.70
    assert moving.psnr_moving is not None
    assert static.psnr_moving is not None
    assert moving.psnr_moving > max(19.0, static.psnr_moving + 2)  # 19.86, 16.08


def test_a_ball_that_rolls_is_followed_as_a_body(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It turns almost three times in 40 images; control nodes alone have 21.1 dB, and 11.6 on what
    moves.

    So short a run would look for it in six of them. Two of three find it; seeds 2 and 4 do with all
    instruction sets.
    """
    monkeypatch.setattr("dyngs.deform.start.STEPS_PER_IMAGE", 1)
    captured = Captured.of(tmp_path, "roll", "--size", "64", "--views", "40")
    few = ("init.num_random=1500", "strategy.max_gaussians=3000", "model.num_random_moving=400")
    report = captured.report(
        "dynamic",
        *few,
        "train.steps=300",
        "model.pilot_runs=false",
        "train.initial_downscale=1",
        "run.seed=4",
    )
    assert report.psnr > 22.8  # 23.19 to 23.28
    assert report.psnr_moving is not None
    # 18.50 to 19.70: processors round differently, and the search for the body amplifies it.
    assert report.psnr_moving > 18.2


def test_a_person(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the box of the person: in poses that were seen, and in those of a clip that was not. The
    body is fitted in few steps, by which the given poses hardly change: its tests tell how good it
    is."""
    effort = FitEffort(side=48, steps=10, draws_per_frame=0)
    for name in ("fit_capture", "place_new_poses"):
        monkeypatch.setattr(
            fitted_capture, name, partial(getattr(fitted_capture, name), effort=effort)
        )
    captured = Captured.of(tmp_path, "human", "--size", "48", "--views", "6", "--cameras", "4")
    keys = [key for key in captured.keys("human") if key not in SMALL]
    run = train(dyngs.load_config("human", [*keys, "train.steps=100", "model.resolution=48"]))
    floors = {"test": 23.0, "pose": 21.8}  # 23.32, 22.18; after 40 steps 21.58, 21.02
    found = {split: evaluate_run(run, split).psnr_person or 0.0 for split in floors}
    assert {split: psnr for split, psnr in found.items() if psnr <= floors[split]} == {}


def test_a_static_scene_before_fixed_cameras_is_trained_as_static(
    still_life: Captured, tmp_path: Path
) -> None:
    """The same bytes as by the static preset, though the dynamic one was requested."""
    source = still_life.root / "capture"
    target = tmp_path / "capture"
    shutil.copytree(source, target)
    described = json.loads((source / "transforms_train.json").read_text())
    frames = []
    for frame in described["frames"][:3]:
        for k in range(6):
            name = f"{frame['file_path']}_{k}"
            shutil.copy(source / f"{frame['file_path']}.png", target / f"{name}.png")
            frames.append(frame | {"file_path": name, "time": k / 5})
    (target / "transforms_train.json").write_text(json.dumps(described | {"frames": frames}))
    (target / "transforms_test.json").unlink()
    captured = Captured(tmp_path)
    runs = [captured.trained(preset, "train.steps=20") for preset in ("dynamic", "static")]
    assert load_resolved(runs[0]).model.kind == "static"
    first, second = (next((run / "checkpoints").iterdir()) for run in runs)
    assert first.read_bytes() == second.read_bytes()
