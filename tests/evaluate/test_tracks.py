"""Errors of tracks against scenes that move as the truth does, not at all, or by a known amount too
little."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import get_args

import numpy as np
import pytest
import torch
from moving_scene import Sliding, camera, moving_scene, row_of_balls, still_scene
from scipy.spatial.transform import Rotation

from dyngs.config.io import load_config
from dyngs.core.camera import Cameras
from dyngs.data.capture import View, all_views
from dyngs.data.synthetic.captures import DynamicOptions, SceneName, write_dynamic_capture
from dyngs.data.tracks import TrueTracks, read_true_tracks
from dyngs.deform.bodies.field import BodyField, BodyRestPose
from dyngs.deform.field import FieldSetup
from dyngs.deform.free import FreeInitialization, FreePrimitives
from dyngs.deform.keys import FreeField
from dyngs.deform.scene import DynamicScene
from dyngs.evaluate.tracks import NO_TRACKS, NONE_OPAQUE, NONE_SEEN, track_scores
from dyngs.gaussians.scene import GaussianScene
from dyngs.gaussians.visibility import VisibilityMasks
from dyngs.models.views import training_cameras


def imported(path: str) -> ModuleType:
    """A program of the repository as a module."""
    file = Path(__file__).parents[2] / path
    spec = importlib.util.spec_from_file_location(f"benchmark_{file.stem}", file)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


MOTION = imported("benchmarks/motion.py")
TIMES = (0.0, 0.25, 0.5, 0.75, 1.0)
PX_PER_UNIT = 20 / 4
"""Focal length over the distance of the camera."""


def sliding_truth(missing_before: int = 0) -> TrueTracks:
    """Points at the second and fourth ball, which go 1 along x over time."""
    start = row_of_balls().means[[1, 3]].numpy()
    points = np.stack([start + np.array([time, 0, 0]) for time in TIMES])
    points[:missing_before] = np.nan
    visible = np.ones((len(TIMES), 2), bool)
    visible[:missing_before] = False
    rows = np.arange(len(TIMES))
    return TrueTracks(points, 7 * np.array(TIMES), np.array([f"v{k}" for k in rows]), rows, visible)


def views() -> list[View]:
    pose = camera().cam_from_world[0].double().numpy()
    return [View(f"v{k}", Path("a"), pose, np.eye(3), 20, 14, time=t) for k, t in enumerate(TIMES)]


def split() -> list[tuple[View, Cameras]]:
    return [(view, camera()) for view in views()]


def only_movers(scene: GaussianScene) -> GaussianScene:
    """The two balls that move, so that each point is carried by them alone."""
    return scene.select(torch.tensor([1, 3]))


def test_true_motion_has_no_error_and_a_still_model_all_of_it() -> None:
    right = track_scores(only_movers(moving_scene(Sliding())), sliding_truth(), split(), views())
    assert right.error_px == pytest.approx(0.0, abs=1e-4)
    assert right.within_5px == 1.0
    still = track_scores(still_scene(), sliding_truth(), split(), views())
    assert still.motion_px == right.motion_px
    assert still.error_px == pytest.approx(still.motion_px)
    # bound at 0.5: half a unit at the ends, a quarter next to it; the time of binding does not
    # count
    assert still.error_px == pytest.approx(PX_PER_UNIT * (0.5 + 0.25 + 0.25 + 0.5) / 4, rel=1e-5)


def test_points_beside_a_gaussian_rotate_with_it() -> None:
    """Half a turn about y: the Gaussians alone, 0.5 from each point, would leave them up to 1
    away."""
    rows = [1, 3]
    center = torch.zeros(1, 3)
    away = np.array([[0.3, 0.2, 0.4], [-0.3, 0.2, -0.4]])
    angles = torch.linspace(0, torch.pi / 2, 9)
    quats = torch.stack([angles.cos(), 0 * angles, angles.sin(), 0 * angles], dim=1)
    splines = {"places": torch.zeros(1, 9, 3), "quats": quats[None]}
    body = BodyField(
        Sliding(speed=0.0),
        BodyRestPose(center, torch.ones(1), torch.zeros(2, dtype=torch.long)),
        splines,
    )
    scene = moving_scene(body)
    turns = [Rotation.from_quat(body.poses(t)[1][0].detach().numpy()[[1, 2, 3, 0]]) for t in TIMES]
    points = np.stack([turn.apply(row_of_balls().means[rows].numpy() + away) for turn in turns])
    truth = replace(sliding_truth(), points=points)
    found = track_scores(only_movers(scene), truth, split(), views())
    assert found.motion_px is not None
    assert found.motion_px > 0.8
    assert found.error_px == pytest.approx(0.0, abs=1e-4)


def test_masked_gaussians_carry_points_too() -> None:
    scene = only_movers(moving_scene(Sliding()))
    masks = VisibilityMasks.pack((0.0, 1.0), torch.tensor([[True, False], [True, False]]))
    masked = track_scores(replace(scene, masks=masks), sliding_truth(), split(), views())
    assert masked == track_scores(scene, sliding_truth(), split(), views())


def turning_back(scale: float) -> tuple[GaussianScene, TrueTracks]:
    """A ball that goes along x to the middle of the clip and back, of one Gaussian per time; and
    where it truly is."""
    ways = [min(time, 1 - time) for time in TIMES]
    means = torch.tensor([[way - 1.0, 0.0, 0.0] for way in ways])
    velocities = scale * torch.tensor([[1.0, 0.0, 0.0]] * 2 + [[0.0] * 3] + [[-1.0, 0.0, 0.0]] * 2)
    start = FreeInitialization(
        torch.zeros(0), (), torch.tensor(TIMES), torch.full((5,), 0.06), velocities
    )
    setup = FieldSetup(torch.zeros(3), torch.ones(3), len(TIMES), len(TIMES), 1.0)
    field = FreePrimitives(FreeField(), setup, torch.Generator()).with_initialization(start)
    field.parameters["velocities"].data[:] = velocities
    scene = DynamicScene(
        gaussians=row_of_balls().replace(means=means),
        training_times=TIMES,
        field=field,
        moving=torch.arange(5),
    )
    rows = np.arange(len(TIMES))
    names = np.array([f"v{k}" for k in rows])
    return scene, TrueTracks(
        means[:, None].numpy(), 7 * np.array(TIMES), names, rows, np.ones((5, 1), bool)
    )


def test_gaussians_with_a_lifetime_hand_on_tracked_points() -> None:
    """Each Gaussian moves one way only. The middle Gaussian is static and hands on no points in the
    first gap."""
    scene, truth = turning_back(1.0)
    found = track_scores(scene, truth, split(), views())
    assert found.motion_px == pytest.approx(PX_PER_UNIT * (0.5 + 0.25 + 0.25 + 0.5) / 4, rel=1e-4)
    assert found.error_px == pytest.approx(PX_PER_UNIT * 0.25, rel=0.05), (
        "a quarter is lost in the first gap each way"
    )
    still = track_scores(turning_back(0.0)[0], truth, split(), views())
    assert still.error_px == pytest.approx(still.motion_px, rel=1e-4)


def test_reasons_say_why_there_is_no_error() -> None:
    assert track_scores(still_scene(), None, split(), views()).reason == NO_TRACKS
    faint = still_scene()
    faint = faint.with_gaussians(faint.gaussians.replace(logit_opacities=torch.full((5,), -5.0)))
    assert track_scores(faint, sliding_truth(), split(), views()).reason == NONE_OPAQUE
    unseen = sliding_truth()
    unseen = replace(unseen, visible=np.zeros_like(unseen.visible))
    assert track_scores(still_scene(), unseen, split(), views()).reason == NONE_SEEN
    other = [(replace(view, name="other"), cameras) for view, cameras in split()]
    assert track_scores(still_scene(), sliding_truth(), other, views()).reason == NONE_SEEN
    assert track_scores(still_scene(), sliding_truth(), split(), []).reason == NONE_SEEN


@pytest.mark.parametrize("name", get_args(SceneName))
def test_the_true_motion_of_the_benchmark_follows_the_true_tracks(
    name: SceneName, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """benchmarks/motion.py: its oracle moves Gaussians as the synthetic scene moves its points, and
    can be trained."""
    monkeypatch.setattr(MOTION, "DRAWN", 1000)
    monkeypatch.setattr(MOTION, "LOOKS", 5)
    root = write_dynamic_capture(
        name, tmp_path / name, DynamicOptions(12, num_times=5, num_cameras=2, samples=1)
    )
    options = [f"data.root={root}", "train.steps=4", "train.initial_downscale=1"]
    trainer = MOTION.oracle(name, load_config(MOTION.PRESET, options))
    gaussians = trainer.model.scene.gaussians
    opaque = trainer.model.scene.with_gaussians(
        gaussians.replace(logit_opacities=gaussians.logit_opacities.detach() + 5)
    )
    capture = trainer.capture
    pairs = list(
        zip(
            capture.splits["test"],
            training_cameras(capture.splits["test"], trainer.config.data),
            strict=True,
        )
    )
    truth = read_true_tracks(capture)
    found = track_scores(opaque, truth, pairs, all_views(capture.splits))
    assert found.error_px is not None
    assert found.motion_px is not None
    assert found.error_px < 0.1
    assert found.motion_px > 10 * found.error_px
    assert all(np.isfinite(trainer.step().loss) for _ in range(2))
