"""Loose cloth: what it is told of a motion, how far it goes, and that runs, files and motions keep it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from bare_person import RESOLUTION, atlas, bare_run, bare_scene, playing
from torch import Tensor

from dyngs.api.train import train
from dyngs.config import Config, DataConfig, HumanModel, RunConfig, TrainConfig
from dyngs.errors import DyngsError
from dyngs.evaluate.report import evaluate_run
from dyngs.human.avatar.corrections import new_corrections
from dyngs.human.avatar.loose import FARTHEST, LAGS, NODES, PAST, TURN_RATE, first_cloth, hold_of, nodes_on, past_motion
from dyngs.human.avatar.posing import BodyPose
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.motion.amass import write_amass
from dyngs.human.motion.motion import Motion, MotionClip
from dyngs.human.pose.skinning import axis_angle_to_matrix
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture
from dyngs.kinds import assemble, restored_scene
from dyngs.runs.avatar import read_avatar, write_avatar
from dyngs.runs.opened import open_run, open_scene
from dyngs.state import part_of, tensors_of
from dyngs.training.trainer import Trainer


def loose_scene(shapes: float = 0.3) -> HumanScene:
    """A person whose cloth moves with every pose, unless ``shapes`` is 0."""
    scene = bare_scene()
    nodes = nodes_on(scene.anchors.points)
    learned = new_corrections(scene.clip, scene.skeleton, scene.anchors, nodes=nodes)
    random = torch.randn(learned["cloth_shapes"].shape, generator=torch.Generator().manual_seed(3))
    values = learned.values() | scene.learned.values() | {"cloth_shapes": shapes * random}
    return replace(scene, learned=learned.restored(values), hold=hold_of(scene.anchors.points, nodes))


def turning(rate: float, count: int, fps: float, start: int = 0) -> MotionClip:
    """Somebody who stands still and from frame ``start`` on turns about the vertical at ``rate`` rad/s."""
    poses = torch.zeros(count, 55, 3)
    poses[:, 0, 1] = rate * (torch.arange(count) - start).clamp_min(0) / fps
    return MotionClip(torch.linspace(0, 1, count, dtype=torch.float64), poses, torch.zeros(count, 3), torch.ones(count))


@torch.no_grad()
def offsets(scene: HumanScene, pose: BodyPose) -> Tensor:
    tight = replace(scene, hold=None)
    return scene.in_pose(pose, 0.0).gaussians.means - tight.in_pose(pose, 0.0).gaussians.means


def some_pose(past: Tensor | None = None, turn: Tensor | None = None) -> BodyPose:
    rotations = axis_angle_to_matrix(0.3 * torch.randn(55, 3, generator=torch.Generator().manual_seed(5)))
    if turn is not None:
        rotations = torch.cat([(turn @ rotations[0])[None], rotations[1:]])
    return BodyPose(rotations, torch.zeros(3), torch.tensor(2.0), past)


def test_cloth_hangs_as_the_skin_before_anything_is_learned() -> None:
    assert not offsets(loose_scene(shapes=0.0), some_pose()).any()


def test_cloth_follows_pose_and_past_within_its_bound() -> None:
    scene = loose_scene(shapes=30.0)
    still, swinging = (offsets(scene, some_pose(past)) for past in (None, torch.ones(PAST)))
    assert float((still - swinging).norm(dim=1).max()) > 0.1
    largest = max(float(x.norm(dim=1).max()) for x in (still, swinging))
    assert 0.5 < largest <= 2.0 * FARTHEST * math.sqrt(3) + 1e-5, "the world has 2 units per metre"


def test_cloth_turns_with_the_person_about_the_vertical() -> None:
    scene = loose_scene()
    turn = axis_angle_to_matrix(torch.tensor([0.0, 1.1, 0.0]))
    scene = replace(scene, clip=replace(scene.clip, poses=torch.zeros_like(scene.clip.poses)))  # y is up
    here, there = offsets(scene, some_pose()), offsets(scene, some_pose(turn=turn))
    assert float(here.abs().max()) > 0.05
    torch.testing.assert_close(there, here @ turn.T, atol=2e-5, rtol=0)
    leaning = axis_angle_to_matrix(torch.tensor([1.1, 0.0, 0.0]))
    assert float((offsets(scene, some_pose(turn=leaning)) - here @ leaning.T).abs().max()) > 0.01, "gravity counts"


def test_velocities_of_a_steady_turn_are_known_and_lag_as_they_should() -> None:
    fps, rate, start = 20.0, 1.5, 4
    clip = turning(rate, 60, fps, start)
    past = past_motion(clip, np.arange(60) / fps)
    assert past.shape == (60, PAST)
    now, later = past[:, 1] * TURN_RATE, past[:, 6 * (len(LAGS) - 1) + 1] * TURN_RATE
    torch.testing.assert_close(now[start + 1 :], torch.full((60 - start - 1,), rate))
    assert not past[: start - 1].any(), "nobody has moved"
    steps = 10
    expected = rate - (rate - float(later[start + 1])) * math.exp(-steps / fps / LAGS[-1])
    assert float(later[start + 1 + steps]) == pytest.approx(expected, rel=1e-4)
    assert float(later[start + 1]) < 0.5 * rate < float(later[-1])
    assert float(past[-1, PAST - 2]) == pytest.approx((rate / TURN_RATE) ** 2, rel=1e-4)
    larger = replace(clip, scale=3 * clip.scale, trans=3 * clip.trans)
    torch.testing.assert_close(past_motion(larger, np.arange(60) / fps), past)
    assert not past_motion(clip.select(torch.tensor([0])), np.zeros(1)).any()


def test_a_step_to_one_side_is_a_velocity_in_the_frame_of_the_pelvis() -> None:
    clip = turning(0.0, 3, 10.0)
    clip.poses[:, 0, 1] = math.pi / 2  # faces +x
    clip.trans[:, 0] = torch.tensor([0.0, 0.1, 0.2])
    past = past_motion(clip, np.arange(3) / 10.0)
    torch.testing.assert_close(past[1, 3:6], torch.tensor([0.0, 0.0, 1.0 / 0.5]), atol=1e-6, rtol=0)


def test_nodes_lie_apart_and_hold_what_is_near_them() -> None:
    points = atlas(RESOLUTION).points
    nodes = nodes_on(points)
    assert len(nodes) == NODES
    apart = torch.cdist(nodes, nodes) + torch.eye(NODES)
    assert float(apart.min()) > 0.03
    assert float(torch.cdist(points, nodes).min(1).values.max()) < 0.12
    hold = hold_of(points, nodes)
    torch.testing.assert_close(hold.weights.sum(1), torch.ones(len(points)))
    assert torch.equal(hold.rows[:, 0], torch.cdist(points.double(), nodes.double()).argmin(1))
    assert len(nodes_on(points[:1])) == 1


def test_what_is_stored_hangs_the_same_and_broken_state_is_refused() -> None:
    scene = loose_scene()
    scene = replace(scene, clip=replace(scene.clip, past=torch.randn(3, PAST)))
    state = part_of(tensors_of(scene.state()), "model")
    again = HumanScene.restored(scene.gaussians, state)
    assert torch.equal(again.time_step(0.4).gaussians.means, scene.time_step(0.4).gaussians.means)
    kept = scene.select(torch.arange(0, len(scene), 3))
    assert torch.equal(kept.time_step(0.4).gaussians.means, scene.time_step(0.4).gaussians.means[::3])
    for name in first_cloth(torch.zeros(2, 3)):
        broken = state | {f"learned.{name}": state[f"learned.{name}"][..., 1:]}
        with pytest.raises(ValueError, match=r"cloth_"):
            HumanScene.restored(scene.gaussians, broken)
        with pytest.raises(KeyError):
            HumanScene.restored(scene.gaussians, {k: x for k, x in state.items() if k != f"learned.{name}"})


def test_an_avatar_file_swings_in_a_motion_as_its_run_does(tmp_path: Path) -> None:
    run = bare_run(loose_scene())
    file = write_avatar(run, tmp_path / "ann.safetensors")
    clip = turning(2.0, 12, 30.0)
    motion = Motion(clip.poses, clip.trans, torch.zeros(10), 30.0, clip.scale)
    write_amass(motion, tmp_path / "turn.npz")
    again = read_avatar(file)
    assert isinstance(again.scene, HumanScene)
    assert again.scene.hold is not None
    assert again.scene.left_out == run.scene.left_out != ()  # type: ignore[union-attr]
    moved = open_scene(file).in_motion(tmp_path / "turn.npz").renderable
    assert isinstance(moved, HumanScene)
    assert moved.played is not None
    assert moved.played.past is not None
    scene = run.scene
    assert isinstance(scene, HumanScene)
    same = playing(run, moved.played).scene
    found, wanted = (x.time_step(0.7).gaussians.means for x in (moved, same))
    torch.testing.assert_close(found, wanted, atol=1e-4, rtol=0)
    still = moved.playing(replace(moved.played, past=None)).time_step(0.7).gaussians.means
    assert float((found - still).detach().norm(dim=1).max()) > 0.005, "velocities count"


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture") / "person"
    return write_human_capture(folder, HumanOptions(size=32, num_frames=3, num_new=2, num_cameras=3, num_test=1))


def at_rate(capture: Path, fps: float) -> None:
    for path in capture.glob("transforms_*.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"fps": fps}))


def loose(capture: Path, run_dir: Path | None = None, **changes: object) -> Config:
    model = {"resolution": 24, "refine_from": 0.2, "sh_degree": 0, "fit": False, "loose": True} | changes
    return Config(
        data=DataConfig(root=capture),
        model=HumanModel(**model),  # type: ignore[arg-type]
        train=TrainConfig(steps=10, log_every=1),
        run=RunConfig(dir=run_dir, threads=1),
    )


def tensors_after(trainer: Trainer, steps: int) -> dict[str, Tensor]:
    for _ in range(steps):
        trainer.step()
    return {name: x.clone() for name, x in trainer.checkpoint().tensors.items()}


def test_it_needs_a_rate_and_refinement(capture: Path) -> None:
    with pytest.raises(DyngsError, match="frames per second; write"):
        assemble(loose(capture))
    at_rate(capture, 15.0)
    with pytest.raises(DyngsError, match=r"needs model\.refine=true"):
        assemble(loose(capture, refine=False))


def test_it_learns_resumes_exactly_and_plays_back_what_was_trained(capture: Path, tmp_path: Path) -> None:
    at_rate(capture, 15.0)
    config = loose(capture, tmp_path / "run")
    straight = assemble(config)
    wanted = tensors_after(straight, 10)
    first = assemble(config)
    tensors_after(first, 6)
    resumed = assemble(config)
    resumed.restore(first.checkpoint())
    found = tensors_after(resumed, 4)
    assert wanted.keys() == found.keys()
    assert all(torch.equal(wanted[name], found[name]) for name in wanted)
    fresh = first_cloth(wanted["model.learned.cloth_nodes"])
    changed = {name for name, x in fresh.items() if not torch.equal(x, wanted[f"model.learned.{name}"])}
    assert changed == fresh.keys() - {"cloth_nodes"}
    played = restored_scene(straight.checkpoint(), config.model)
    assert isinstance(played, HumanScene)
    trained, _ = played.in_frame(1)
    torch.testing.assert_close(played.at(0.5).means, trained.means.detach(), rtol=0, atol=1e-5)


def test_a_run_swings_in_its_new_poses(capture: Path, tmp_path: Path) -> None:
    at_rate(capture, 15.0)
    train(loose(capture, tmp_path / "run"))
    scene = open_run(tmp_path / "run").of_split("pose").renderable
    assert isinstance(scene, HumanScene)
    assert scene.played is not None
    assert scene.played.past is not None
    assert scene.played.past.any()
    assert evaluate_run(tmp_path / "run", "pose", refine_poses=True).own_poses is not None
