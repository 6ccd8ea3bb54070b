"""Frames of one moving camera: pixels, rays, ball surfaces and residuals of the static model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rolling_ball import rolling
from tiny_fields import cloud

from dyngs.core.camera import Cameras
from dyngs.data.capture import View
from dyngs.data.loader import Image
from dyngs.deform.bodies.paths import FrameStack, order_moving_camera, render_frame_stack
from dyngs.gaussians.rendering import RenderOptions


def test_rays_go_through_the_points_that_they_show() -> None:
    frame_stack, centers, _ = rolling()
    which = np.arange(len(frame_stack))
    pixels, depths = frame_stack.project(which, centers)
    ways = frame_stack.rays(which, pixels)
    apart = np.cross(centers - frame_stack.centers, ways)
    assert np.linalg.norm(apart, axis=1).max() < 1e-6
    assert depths == pytest.approx(
        ((centers - frame_stack.centers) * frame_stack.poses[:, 2, :3]).sum(1)
    )


def test_pixels_on_a_ball_see_its_surface() -> None:
    """Pixels on the ball differ from the static model unless the ball is occluded."""
    frame_stack, centers, _ = rolling()
    rows, columns, normals = frame_stack.ball_pixels(3, centers[3], 0.28)
    assert len(rows) > 50
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1)
    points = centers[3] + 0.28 * normals
    pixels, _ = frame_stack.project(np.full(len(rows), 3), points)
    assert pixels == pytest.approx(np.stack([columns, rows], axis=1) + 0.5)
    inside = frame_stack.differences()[3, rows, columns]
    assert inside.mean() > 2 * frame_stack.differences()[3].mean()
    values = {name: x for name, x in vars(frame_stack).items() if name != "centers"}
    hidden = FrameStack(**values | {"depths": np.full_like(frame_stack.depths, 0.1)})
    assert not len(hidden.ball_pixels(3, centers[3], 0.28)[0])
    assert not len(frame_stack.ball_pixels(3, np.array([50.0, 0, 0]), 0.28)[0])


def test_one_camera_shows_each_time_once() -> None:
    view = View("a", Path("a.png"), np.eye(4), np.eye(3), 4, 4)
    poses = [np.eye(4) + 0.1 * i * np.eye(4, k=3) for i in range(3)]
    views = [
        replace(view, time=time, cam_from_world=pose)
        for time, pose in zip((0.5, 0.0, 1.0), poses, strict=True)
    ]
    assert order_moving_camera(views) == [1, 0, 2]
    assert order_moving_camera([*views, views[0]]) is None
    assert order_moving_camera([replace(view, time=None)]) is None
    assert order_moving_camera([replace(v, cam_from_world=np.eye(4)) for v in views]) is None


def test_masked_pixels_have_no_residual() -> None:
    gaussians = cloud()
    camera = one_camera_of(8)
    rgb = torch.rand(8, 8, 3)
    mask = torch.zeros(8, 8)
    mask[:4] = 1
    image = Image("a", camera, rgb, torch.ones(8, 8), mask, 0.5)
    frame_stack = render_frame_stack([image], gaussians, RenderOptions(), torch.ones(3))
    assert np.array_equal(frame_stack.alphas[0, :4], np.ones((4, 8)))
    assert np.array_equal(frame_stack.alphas[0, 4:], frame_stack.static_alphas[0, 4:])
    assert np.array_equal(frame_stack.images[0, :4], rgb[:4].numpy())
    assert np.array_equal(frame_stack.images[0, 4:], frame_stack.static[0, 4:])
    assert frame_stack.times.tolist() == [0.5]


def one_camera_of(size: int) -> Cameras:
    intrinsics = torch.tensor([[[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]]])
    pose = torch.eye(4)[None].clone()
    pose[0, 2, 3] = 4
    return Cameras(pose, intrinsics, size, size)
