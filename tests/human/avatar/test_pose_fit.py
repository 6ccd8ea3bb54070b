"""Poses fitted to images: those that are off are found again, and nothing but poses changes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
import torch
from posed_person import (
    SIZE,
    WHITE,
    Shown,
    disturbed,
    images_of,
    joints_of,
    mean_psnr,
    person_and_cameras,
)

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image, ImageLoader
from dyngs.human.avatar import pose_fit
from dyngs.human.avatar.pose_fit import (
    IMAGE_COMPARISON,
    SILHOUETTE_COMPARISON,
    PoseComparison,
    fit_poses_to_images,
)
from dyngs.human.avatar.scene import HumanScene


@pytest.fixture(scope="module")
def truth(person: Path) -> tuple[HumanScene, list[Cameras]]:
    return person_and_cameras(person)


def fitted(
    scene: HumanScene, images: list[Image], comparison: PoseComparison = IMAGE_COMPARISON
) -> tuple[HumanScene, list[int]]:
    return fit_poses_to_images(scene, cast(ImageLoader, Shown(images)), WHITE, comparison)


def test_disturbed_poses_are_found_again(
    truth: tuple[HumanScene, list[Cameras]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_fit, "MAX_WINDOWS", 4)
    scene, cameras = truth
    images = images_of(scene, cameras, list(scene.times[:2]))
    start = disturbed(scene)
    fit, updates = fitted(start, images)
    assert mean_psnr(fit, images) > mean_psnr(start, images) + 5
    assert len(updates) == 2
    for row in range(2):
        true = joints_of(scene, scene.played_clip, row)
        before, after = (joints_of(scene, x.played_clip, row) for x in (start, fit))
        errors = [float((x - true).norm(dim=1).mean()) for x in (before, after)]
        assert errors[1] < 0.5 * errors[0]
        assert errors[0] > 0.03
    assert fit.gaussians is start.gaussians
    assert fit.learned is start.learned


def test_fitting_keeps_correct_poses(
    truth: tuple[HumanScene, list[Cameras]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_fit, "MAX_WINDOWS", 1)
    scene, cameras = truth
    images = images_of(scene, cameras[:1], [0.0])
    fit, _ = fitted(scene, images)
    torch.testing.assert_close(
        fit.played_clip.poses, scene.played_clip.poses[:1], rtol=0, atol=1e-5
    )
    torch.testing.assert_close(
        fit.played_clip.trans, scene.played_clip.trans[:1], rtol=0, atol=1e-6
    )


def test_silhouettes_alone_find_poses_again(
    truth: tuple[HumanScene, list[Cameras]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_fit, "MAX_WINDOWS", 6)
    scene, cameras = truth
    images = images_of(scene, cameras, list(scene.times[:1]))
    start = disturbed(scene)
    without_colours = [
        replace(x, rgb_premultiplied=torch.rand_like(x.rgb_premultiplied)) for x in images
    ]
    fit, _ = fitted(start, without_colours, SILHOUETTE_COMPARISON)
    true = joints_of(scene, scene.played_clip, 0)
    before, after = (joints_of(x, x.played_clip, 0) for x in (start, fit))
    errors = [float((x - true).norm(dim=1).mean()) for x in (before, after)]
    assert errors[1] < 0.5 * errors[0]
    assert mean_psnr(fit, images) > mean_psnr(start, images) + 3


def test_one_silhouette_moves_the_person_and_turns_no_joint(
    truth: tuple[HumanScene, list[Cameras]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_fit, "MAX_WINDOWS", 6)
    scene, cameras = truth
    images = images_of(scene, cameras[:1], [0.0])
    camera = cameras[0].cam_from_world[0]
    sideways = camera[0, :3] * 0.03  # in the image, where one view shows it
    start = scene.with_motion(replace(scene.clip, trans=scene.clip.trans + sideways))
    fit, _ = fitted(start, images, SILHOUETTE_COMPARISON)
    torch.testing.assert_close(
        fit.played_clip.poses, start.played_clip.poses[:1], rtol=0, atol=1e-6
    )
    off = [(x.played_clip.trans[0] - scene.played_clip.trans[0]).norm() for x in (start, fit)]
    assert off[1] < 0.4 * off[0]


def test_masked_pixels_say_nothing_about_the_pose(
    truth: tuple[HumanScene, list[Cameras]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_fit, "MAX_WINDOWS", 1)
    scene, cameras = truth
    start = disturbed(scene)
    images = images_of(scene, cameras[:1], [0.0], mask=torch.zeros(SIZE, SIZE))
    fit, _ = fitted(start, images)
    torch.testing.assert_close(
        fit.played_clip.poses, start.played_clip.poses[:1], rtol=0, atol=1e-5
    )
