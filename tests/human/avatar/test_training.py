"""The avatar in training: it learns, repeats to the byte, resumes exactly, follows edits, and plays
its clip back."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_bodies import model, write_npz
from torch import Tensor

from dyngs.api.train import train
from dyngs.config import (
    Config,
    DataConfig,
    DefaultStrategy,
    OptimConfig,
    RunConfig,
    TrainConfig,
)
from dyngs.config.io import RESOLVED_NAME, save_config
from dyngs.core.errors import DyngsError
from dyngs.evaluate.report import evaluate_run
from dyngs.gaussians.scene import restore_scene
from dyngs.human.avatar import pose_fit
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.joints import mirrored_joints
from dyngs.human.keys import HumanModel
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture
from dyngs.runs.checkpoint import load_run, save_checkpoint
from dyngs.runs.opened import open_run
from dyngs.training.new_trainer import build_trainer
from dyngs.training.trainer import Trainer

BUSY = DefaultStrategy(start=1, stop=30_000, every=4, grow=False, prune_opacity=0.895)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture") / "person"
    return write_human_capture(
        folder, HumanOptions(size=32, num_frames=3, num_pose_frames=2, num_cameras=3, num_test=1)
    )


def tiny(capture: Path, run_dir: Path | None = None, steps: int = 10, **changes: object) -> Config:
    model = {
        "resolution": 24,
        "sh_degree": 0,
        "fit": False,
    } | changes
    return Config(
        data=DataConfig(root=capture),
        model=HumanModel(**model),  # type: ignore[arg-type]
        strategy=BUSY,
        optim=OptimConfig(lr_sh_dc=0.02),
        train=TrainConfig(steps=steps, log_every=1, alpha_weight=0.1),
        run=RunConfig(dir=run_dir, threads=1),
    )


def human(trainer: Trainer) -> HumanScene:
    assert isinstance(trainer.model.scene, HumanScene)
    return trainer.model.scene


def tensors_after(trainer: Trainer, steps: int) -> dict[str, Tensor]:
    for _ in range(steps):
        trainer.step()
    return {name: x.clone() for name, x in trainer.checkpoint().tensors.items()}


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_a_seed_decides_every_byte_and_resuming_changes_none(capture: Path) -> None:
    config = tiny(capture)
    straight = tensors_after(build_trainer(config), 10)
    assert same(straight, tensors_after(build_trainer(config), 10))
    first = build_trainer(config)
    tensors_after(first, 6)
    resumed = build_trainer(config)
    resumed.restore(first.checkpoint())
    assert same(straight, tensors_after(resumed, 4))
    counts = {len(build_trainer(config).model.scene), len(straight["gaussians.means"])}
    assert len(counts) == 2, "some must be pruned, or this test shows little"
    learned = [
        straight[f"model.learned.{name}"]
        for name in ("poses", "trans", "turns", "joints", "weights")
    ]
    assert all(bool((x != 0).any()) for x in learned)


def test_training_learns_and_evaluates_on_both_splits(capture: Path, tmp_path: Path) -> None:
    config = tiny(capture, tmp_path / "run", steps=60)
    start = restore_scene(build_trainer(config).checkpoint(), config.model)
    run = load_run(train(config))
    assert isinstance(run.scene, HumanScene)
    assert isinstance(start, HumanScene)
    assert float((run.scene.played_clip.poses - start.played_clip.poses).abs().max()) > 0
    for split in ("test", "pose"):
        report = evaluate_run(tmp_path / "run", split)
        assert report.psnr > 18
        assert report.psnr_person is not None
        assert report.psnr_person < report.psnr
        assert len(report.psnr_per_time) == (3 if split == "test" else 2)


@pytest.mark.parametrize("own_body", [False, True])
def test_playback_equals_the_trained_avatar(capture: Path, tmp_path: Path, own_body: bool) -> None:
    body = write_npz(tmp_path / "model.npz", model("smplx")) if own_body else None
    trainer = build_trainer(tiny(capture, body=body))
    assert (human(trainer).shapes is not None) == own_body
    tensors_after(trainer, 8)
    image = trainer.images[4]
    drawn = trainer.model.training.time_step(trainer.model.scene, image, trainer.done + 1).gaussians
    scene = restore_scene(trainer.checkpoint(), trainer.config.model)
    played = scene.at(image.time)
    torch.testing.assert_close(played.means, drawn.means.detach(), rtol=0, atol=1e-5)
    torch.testing.assert_close(
        played.log_scales.sum(1), drawn.log_scales.detach().sum(1), rtol=0, atol=1e-4
    )
    assert not scene.is_static
    assert len(scene.rows) == len(scene)


def test_shared_corrections_are_trained_before_poses_per_frame(capture: Path) -> None:
    trainer = build_trainer(tiny(capture, steps=20))
    early = tensors_after(trainer, 5)
    names = [f"model.learned.{name}" for name in ("turns", "joints", "poses", "trans")]
    assert [bool(early[name].any()) for name in names] == [True, True, False, False]
    late = tensors_after(trainer, 2)
    assert all(late[name].any() for name in names)
    other = late["model.learned.joints"][list(mirrored_joints(55))] * torch.tensor([-1.0, 1, 1])
    torch.testing.assert_close(late["model.learned.joints"], other)


def test_a_capture_without_bodies_is_an_error(capture: Path, tmp_path: Path) -> None:
    from dyngs.data.synthetic.captures import StaticOptions, write_static_capture

    write_static_capture(
        tmp_path / "still", StaticOptions(size=16, num_train=2, num_test=1, samples=1)
    )
    with pytest.raises(DyngsError, match="has no body parameters"):
        build_trainer(tiny(tmp_path / "still"))


def test_motions_rest_and_splits_are_played(capture: Path, tmp_path: Path) -> None:
    trainer = build_trainer(tiny(capture))
    save_checkpoint(tmp_path, trainer.checkpoint(), 0.0)
    save_config(trainer.config, tmp_path / RESOLVED_NAME)
    run = open_run(tmp_path)
    own = run.play_motion(capture / "body_train.npz")
    assert len(own.scene.times) == 3
    first = run.scene.at(0.0)
    again = own.scene.at(0.0)
    torch.testing.assert_close(again.log_scales, first.log_scales, rtol=0, atol=1e-4)
    rest = run.at_rest().scene
    assert rest.is_static
    spread = rest.at(None).means.amax(0) - rest.at(None).means.amin(0)
    assert float(spread[0]) > 1.5, "arms to the sides"


def test_a_fit_far_from_the_origin_is_played_exactly(capture: Path, tmp_path: Path) -> None:
    trainer = build_trainer(tiny(capture))
    save_checkpoint(tmp_path, trainer.checkpoint(), 0.0)
    save_config(trainer.config, tmp_path / RESOLVED_NAME)
    near = open_run(tmp_path)
    offset = (500_000.0, 4_600_000.0, 120.0)
    far = replace(near, info=replace(near.info, world_offset=offset))
    with np.load(capture / "body_train.npz") as file:
        fit = dict(file)
    fit["scale"] = 1.01 * np.ones(len(fit["poses"]))
    for name, shift in (("near", np.zeros(3)), ("far", np.array(offset))):
        write_npz(tmp_path / f"{name}.npz", fit | {"trans": fit["trans"] + shift})
    played = (
        run.play_motion(tmp_path / f"{name}.npz").scene
        for run, name in ((near, "near"), (far, "far"))
    )
    there, here = (scene.at(0.5).means for scene in played)
    torch.testing.assert_close(there, here, rtol=0, atol=1e-6)


def test_only_unseen_texels_are_filled_after_the_last_step(
    capture: Path,
) -> None:
    def after(step: int, fill: bool) -> tuple[dict[str, Tensor], str]:
        trainer = build_trainer(tiny(capture, steps=4, fill_unseen=fill))
        reports = [trainer.step() for _ in range(step)]
        found = {name: x.clone() for name, x in trainer.checkpoint().tensors.items()}
        return found, reports[-1].message or ""

    assert same(after(3, True)[0], after(3, False)[0])
    (filled, line), (plain, silence) = after(4, True), after(4, False)
    assert "that few views show" in line, "three cameras do not see all"
    assert "that few views show" not in silence
    changed = {name for name in plain if not torch.equal(plain[name], filled[name])}
    assert changed == {"gaussians.sh", "gaussians.means", "gaussians.logit_opacities"}
    assert set(filled) == set(plain)
    changes = (filled["gaussians.sh"] - plain["gaussians.sh"]).abs().flatten(1).amax(1)
    assert changes.min() < 0.02 * changes.max(), "what was seen keeps its colour"


def turned(capture: Path, out: Path) -> Path:
    """The same capture, in whose poses hips, knees, shoulders and elbows are turned by 23 degrees
    to either side."""
    shutil.copytree(capture, out)
    with np.load(out / "body_train.npz") as file:
        body = dict(file)
    poses = body["poses"].reshape(len(body["poses"]), -1, 3)
    poses[:, [1, 2, 4, 5, 16, 17, 18, 19]] += np.random.default_rng(0).choice(
        [-0.4, 0.4], (len(poses), 8, 3)
    )
    np.savez(out / "body_train.npz", **body | {"poses": poses.reshape(len(poses), -1)})
    return out


def test_wrong_poses_are_fitted_to_the_images_and_resuming_changes_no_byte(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_fit, "REFIT_STARTS", (10 / 240,))
    config = tiny(turned(capture, tmp_path / "turned"), steps=240)
    trainer = build_trainer(config)
    lines = [trainer.step().message or "" for _ in range(16)]
    assert "refitting body poses" in lines[9]
    assert "".join(lines[:9] + lines[10:]) == ""
    straight = {name: x.clone() for name, x in trainer.checkpoint().tensors.items()}
    given = build_trainer(config).checkpoint().tensors["model.clip.poses"]
    assert (straight["model.clip.poses"] != given).flatten(1).any(1).all(), "every frame"
    first = build_trainer(config)
    tensors_after(first, 11)
    second = build_trainer(config)
    second.restore(first.checkpoint())
    assert same(straight, tensors_after(second, 5))


def test_poses_that_views_gain_nothing_from_stay_for_good(
    capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_fit, "REFIT_STARTS", (10 / 240, 14 / 240))
    trainer = build_trainer(tiny(capture, steps=240))
    given = human(trainer).clip.poses.clone()
    lines = [trainer.step().message or "" for _ in range(12)]
    assert lines[9].startswith("body poses not refitted")
    resumed = build_trainer(tiny(capture, steps=240))
    resumed.restore(trainer.checkpoint())
    assert all(resumed.step().message is None for _ in range(4)), "it is not tried again"
    assert torch.equal(human(resumed).clip.poses, given)
