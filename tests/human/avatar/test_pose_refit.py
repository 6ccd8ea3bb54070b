"""Poses of training fitted again: wrong ones gain and come nearer to the truth, right ones do not
gain."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
import torch
from posed_person import WHITE, Shown, disturbed, images_of, joints_of, person_and_cameras

from dyngs.core.camera import Cameras
from dyngs.data.loader import ImageLoader
from dyngs.human.avatar.pose_fit import MIN_JOINT_SHIFT, MIN_LOSS_DECREASE, PoseRefit
from dyngs.human.avatar.scene import HumanScene


@pytest.fixture(scope="module")
def truth(person: Path) -> tuple[HumanScene, list[Cameras]]:
    return person_and_cameras(person)


def refit_to(scene: HumanScene, cameras: list[Cameras]) -> PoseRefit:
    return PoseRefit(
        cast(ImageLoader, Shown(images_of(scene, cameras, list(scene.times)))), WHITE, 400
    )


def trained_on(scene: HumanScene) -> HumanScene:
    """The same person whose clip of training is the one with turned joints, and some corrections of
    it."""
    clip = disturbed(scene).replacement_clip
    assert clip is not None
    copied = scene.learned.with_state({name: x.tensor for name, x in scene.learned.state().items()})
    return replace(scene, clip=clip, learned=copied)


def test_views_left_out_gain_from_wrong_poses_only(truth: tuple[HumanScene, list[Cameras]]) -> None:
    scene, cameras = truth
    refit = refit_to(scene, cameras)
    assert refit.applies_to(scene)
    gain, move = refit.measure_gain(scene)
    assert gain < MIN_LOSS_DECREASE
    assert move < MIN_JOINT_SHIFT
    gain, move = refit.measure_gain(trained_on(scene))
    assert gain > MIN_LOSS_DECREASE + 1
    assert move > 5 * MIN_JOINT_SHIFT


def test_one_row_comes_nearer_to_the_truth_and_all_else_stays(
    truth: tuple[HumanScene, list[Cameras]],
) -> None:
    scene, cameras = truth
    start = trained_on(scene)
    with torch.no_grad():
        start.learned["poses"].fill_(0.01)
        start.learned["trans"].fill_(0.002)
    true = joints_of(scene, scene.played_clip, 1)
    before = float((joints_of(start, start.played_clip, 1) - true).norm(dim=1).mean())
    found = refit_to(scene, cameras).refit_frame(start, 1)
    after = float((joints_of(found, found.played_clip, 1) - true).norm(dim=1).mean())
    assert after < 0.6 * before
    for name in ("poses", "trans"):
        assert torch.equal(getattr(found.clip, name)[::2], getattr(start.clip, name)[::2])
        assert not torch.equal(getattr(found.clip, name)[1], getattr(start.clip, name)[1])
        assert found.learned[name].abs().amax(-1)[1].max() == 0
        assert found.learned[name][::2].abs().min() > 0
    assert found.gaussians is start.gaussians
