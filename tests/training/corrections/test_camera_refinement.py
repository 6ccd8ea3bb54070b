"""Corrections of cameras: their gradients, what they leave alone, and that they find cameras that
were disturbed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import random_scene
from torch import Tensor

from dyngs.config import CameraConfig, Config, DataConfig, RandomInit, RunConfig, TrainConfig
from dyngs.core.camera import Cameras
from dyngs.core.metrics import psnr
from dyngs.data.capture import View
from dyngs.data.loader import Image
from dyngs.gaussians.static_scene import StaticScene
from dyngs.training.corrections.camera_refinement import (
    MIN_POSES,
    STARTS,
    CameraCorrections,
    CameraRefinement,
    apply_correction,
    common_motion_basis,
    correction_gradients,
    fit_camera_to_image,
    with_camera_gradients,
)
from dyngs.training.new_trainer import build_trainer
from dyngs.training.trainer import Trainer

SIZE = 2.5


def turned(vector: Tensor) -> Tensor:
    """Return the rotation by ``vector``, rad."""
    x, y, z = vector.tolist()
    return torch.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64))


def random_view(index: int, generator: torch.Generator, **changes: object) -> View:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = turned(torch.randn(3, generator=generator, dtype=torch.float64))
    pose[:3, 3] = torch.randn(3, generator=generator, dtype=torch.float64)
    intrinsics = np.array([[300.0, 0, 160], [0, 290, 120], [0, 0, 1]])
    view = View(f"{index}", Path(f"{index}.png"), pose.numpy(), intrinsics, 320, 240)
    return replace(view, **changes)  # type: ignore[arg-type]


def random_views(count: int, seed: int = 0) -> list[View]:
    generator = torch.Generator().manual_seed(seed)
    return [random_view(i, generator) for i in range(count)]


def camera_of(view: View) -> Cameras:
    return Cameras(
        torch.as_tensor(view.cam_from_world)[None],
        torch.as_tensor(view.intrinsics)[None],
        view.width,
        view.height,
    )


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_slopes_are_the_gradients_of_a_correction(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    camera = camera_of(random_view(0, generator))
    weights = torch.randn(3, 4, generator=generator, dtype=torch.float64)
    by_lens = torch.randn(4, generator=generator, dtype=torch.float64)

    def loss(camera: Cameras) -> Tensor:
        k = camera.intrinsics[0]
        # all that the rasterizer takes of it
        of_lens = torch.stack([k[0, 0], k[1, 1], k[0, 2], k[1, 2]])
        return (camera.cam_from_world[0, :3] * weights).sum() + (of_lens * by_lens).sum()

    leaf = with_camera_gradients(camera)
    by_pose, by_intrinsics = torch.autograd.grad(loss(leaf), [leaf.cam_from_world, leaf.intrinsics])
    pose, lens = (torch.zeros(n, dtype=torch.float64, requires_grad=True) for n in (6, 3))
    truth = torch.autograd.grad(loss(apply_correction(camera, pose, lens, SIZE)), [pose, lens])
    for ours, theirs in zip(
        correction_gradients(camera, by_pose, by_intrinsics, SIZE), truth, strict=True
    ):
        torch.testing.assert_close(ours, theirs)


def test_a_correction_means_the_same_at_every_scale() -> None:
    """The same point of the world moves by the same fraction of the image."""
    view = random_views(1)[0]
    small = replace(
        view, intrinsics=np.diag([0.5, 0.5, 1.0]) @ view.intrinsics, width=160, height=120
    )
    pose = torch.tensor([0.01, -0.02, 0.03, 0.1, 0.2, -0.1])
    lens = torch.tensor([0.05, 0.01, -0.02])
    large, little = (apply_correction(camera_of(v), pose, lens, SIZE) for v in (view, small))
    torch.testing.assert_close(large.cam_from_world, little.cam_from_world)
    torch.testing.assert_close(0.5 * large.intrinsics[0, :2], little.intrinsics[0, :2])


def test_a_lens_of_few_poses_stays() -> None:
    few = random_views(MIN_POSES - 1)
    many = random_views(MIN_POSES)
    assert CameraCorrections(few, SIZE).rows(few[0]) == (0, None)
    assert CameraCorrections(many, SIZE).rows(many[0]) == (0, 0)
    standing = [replace(many[0], name=f"{i}") for i in range(MIN_POSES)]
    assert CameraCorrections(standing, SIZE).rows(many[0]) == (0, None)


@pytest.mark.parametrize("seed", [0, 1])
def test_common_motions_change_no_image(seed: int) -> None:
    """A similarity of the world that scene and cameras follow together is one of them: to first
    order."""
    views = random_views(6, seed)
    small = 1e-5
    generator = torch.Generator().manual_seed(seed)
    turn, shift = (torch.randn(3, generator=generator, dtype=torch.float64) for _ in range(2))
    grown = 1 + 0.7 * small
    found = []
    centers = np.stack([np.linalg.inv(view.cam_from_world)[:3, 3] for view in views])
    for view, center in zip(views, centers, strict=True):
        camera = torch.as_tensor(view.cam_from_world)
        pivot = torch.as_tensor(centers.mean(0))
        moved = (
            turned(small * turn) @ (grown * (torch.as_tensor(center) - pivot))
            + pivot
            + small * shift
        )
        rotation = camera[:3, :3] @ turned(small * turn).T
        change = rotation @ camera[:3, :3].T  # of the camera's axes
        vector = (
            torch.stack(
                [
                    change[2, 1] - change[1, 2],
                    change[0, 2] - change[2, 0],
                    change[1, 0] - change[0, 1],
                ]
            )
            / 2
        )
        translation = -rotation @ moved - change @ camera[:3, 3]
        found.append(torch.cat([vector, translation / SIZE]) / small)
    correction = torch.stack(found).view(-1)
    basis = common_motion_basis(views, SIZE).double()
    assert basis.shape == (36, 7)
    torch.testing.assert_close(
        basis @ (basis.T @ correction), correction, rtol=0, atol=1e-4 * float(correction.norm())
    )


def image_of(camera: Cameras) -> Image:
    return Image("", camera, torch.zeros(1, 1, 3), None, None, None)


def points_seen(camera: Cameras, points: Tensor) -> Tensor:
    """Return where points (N, 3) are seen, px."""
    local = points @ camera.cam_from_world[0, :3, :3].T + camera.cam_from_world[0, :3, 3]
    pixels = local @ camera.intrinsics[0].T
    return pixels[:, :2] / pixels[:, 2:]


def test_disturbed_cameras_are_found() -> None:
    """Known points in view of cameras that were disturbed, whose errors in pixels are the loss."""
    generator = torch.Generator().manual_seed(3)
    steps = 1500
    points = torch.randn(40, 3, generator=generator)
    truth = []
    views = []
    for view in random_views(MIN_POSES, 5):
        pose = view.cam_from_world.copy()
        pose[:3, 3] = [0, 0, 8]
        disturbed = pose.copy()
        noise = torch.randn(6, generator=generator, dtype=torch.float64)
        disturbed[:3, :3] = turned(0.009 * noise[:3]).numpy() @ pose[:3, :3]
        disturbed[:3, 3] += 0.02 * noise[3:].numpy()
        truth.append(points_seen(camera_of(replace(view, cam_from_world=pose)), points.double()))
        views.append(replace(view, cam_from_world=disturbed))
    refinement = CameraRefinement(views, SIZE, steps)
    errors = []
    for step in range(1, steps + 1):
        index = step % len(views)
        camera = with_camera_gradients(
            refinement.corrections.correct_cameras(views[index], camera_of(views[index]))
        )
        error = (points_seen(camera, points.double()) - truth[index]).norm(dim=-1).mean()
        error.backward()
        refinement.after_backward(index, step, image_of(camera))
        errors.append(float(error.detach()))
    first, last = (
        np.mean(errors[part]) for part in (slice(0, int(STARTS * steps)), slice(-8, None))
    )
    assert last < 0.2 * first


def trainer_of(root: Path, refine: str) -> Trainer:
    return build_trainer(
        Config(
            data=DataConfig(root=root),
            camera=CameraConfig(refine=refine),  # type: ignore[arg-type]
            init=RandomInit(num_random=60),
            train=TrainConfig(steps=40),
            run=RunConfig(threads=1),
        )
    )


def test_a_resumed_run_has_the_same_bytes(still: Path) -> None:
    whole, first, second = (trainer_of(still, "always") for _ in range(3))
    for _ in range(24):
        whole.step()
    for _ in range(12):
        first.step()
    second.restore(first.checkpoint())
    for _ in range(12):
        second.step()
    ends = whole.checkpoint().tensors, second.checkpoint().tensors
    assert ends[0].keys() == ends[1].keys()
    assert bool(ends[0]["cameras.poses"].any())
    assert all(torch.equal(x, ends[1][name]) for name, x in ends[0].items())


BLACK = torch.zeros(3)
WRONG = torch.tensor([0.01, -0.012, 0.008, 0.01, 0.008, -0.01])


def scene_and_image() -> tuple[StaticScene, Image]:
    """Return a scene and its render, with the camera that is right."""
    drawn = random_scene(n=60, views=1, size=(48, 40), seed=2).to(torch.float32)
    scene = StaticScene(gaussians=drawn.gaussians)
    rgb = scene.render(drawn.cameras, None, background=BLACK).rgb[0]
    return scene, Image("own", drawn.cameras, rgb, None, None, None)


def shown(scene: StaticScene, image: Image) -> Tensor:
    return scene.render(image.cameras, None, background=BLACK).rgb[0]


@pytest.mark.parametrize("left_only", [False, True])
def test_the_pose_of_a_render_is_found_again(left_only: bool) -> None:
    scene, right = scene_and_image()
    wrong = replace(right, cameras=apply_correction(right.cameras, WRONG, None, 3.0))
    if left_only:
        mask = torch.zeros(40, 48)
        mask[:, :24] = 1
        wrong = replace(wrong, mask=mask)
    found = replace(right, cameras=fit_camera_to_image(scene, wrong, BLACK, 3.0))
    before, after = (psnr(shown(scene, x), right.rgb_premultiplied) for x in (wrong, found))
    assert after > before + 10
    assert torch.equal(found.cameras.intrinsics, right.cameras.intrinsics)
