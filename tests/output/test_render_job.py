"""Render jobs: frames are renders one by one, each at its time, and what was in an image stays in it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scene import Sliding, camera, moving_scene, still_scene
from two_balls import balls_job, cameras_around, two_balls

from dyngs.camera import Cameras
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.output.camera_paths import static_path
from dyngs.output.render_job import RenderJob, job_frames, render_frame, resize_cameras

sizes = st.integers(1, 400)


@settings(max_examples=25, deadline=None)
@given(old=st.tuples(sizes, sizes), new=st.tuples(sizes, sizes))
def test_resizing_keeps_corners_inside_and_pixels_square(old: tuple[int, int], new: tuple[int, int]) -> None:
    intrinsics = torch.tensor([[[300.0, 0, old[0] / 2 + 3], [0, 300.0, old[1] / 2 - 2], [0, 0, 1]]])
    cameras = resize_cameras(Cameras(torch.eye(4)[None], intrinsics, *old), *new)
    corners = torch.tensor([[0.0, 0.0, 1.0], [old[0], old[1], 1.0]])
    seen = (cameras.intrinsics[0] @ torch.linalg.inv(intrinsics[0]) @ corners.T).T[:, :2]
    slack = 1e-3 * max(*old, *new)  # float32
    assert (cameras.width, cameras.height) == new
    assert (seen >= -slack).all()
    assert (seen <= torch.tensor(new) + slack).all()
    assert cameras.intrinsics[0, 0, 0] == pytest.approx(float(cameras.intrinsics[0, 1, 1]))
    middle = seen.mean(dim=0)
    assert torch.allclose(middle, torch.tensor(new) / 2, atol=slack)


def test_frames_are_the_renders_one_by_one() -> None:
    gaussians, cameras = two_balls(), cameras_around(3)
    options, background = RenderOptions(depth="expected"), torch.tensor([0.1, 0.2, 0.9])
    together = render(gaussians, cameras, options, background=background)
    frames = list(job_frames(balls_job(cameras, options, background)))
    assert len(frames) == 3
    for i, frame in enumerate(frames):
        np.testing.assert_allclose(frame.rgb, together.rgb[i].clamp(0, 1), atol=1e-6)
        np.testing.assert_allclose(frame.alpha, together.alpha[i], atol=1e-6)
        assert frame.depth is not None
        assert together.depth is not None
        np.testing.assert_allclose(frame.depth, together.depth[i], rtol=1e-5)
    np.testing.assert_allclose(frames[0].rgb[0, 0], [0.1, 0.2, 0.9], atol=0.01)  # a corner shows the background
    red = frames[0].rgb[9, 9]
    assert red[0] > 0.8
    assert red[1] < 0.2
    assert frames[0].depth is not None
    assert abs(frames[0].depth[9, 9] - 4) < 0.01
    assert next(job_frames(balls_job(cameras))).depth is None


def test_frames_are_drawn_lazily() -> None:
    frames = job_frames(balls_job(cameras_around(3)))
    next(frames)
    frames.close()  # type: ignore[attr-defined]


def test_each_frame_shows_the_scene_at_its_time() -> None:
    scene, times = moving_scene(Sliding()), (0.0, 0.3, 1.0)
    frames = list(job_frames(RenderJob(scene, static_path(camera(), times))))
    for frame, time in zip(frames, times, strict=True):
        np.testing.assert_array_equal(frame.rgb, render_frame(scene, scene.time_step(time), camera()).rgb)
    assert np.abs(frames[0].rgb - frames[2].rgb).max() > 0.1


def test_equal_times_deform_once() -> None:
    motion = Sliding()
    job = RenderJob(moving_scene(motion), static_path(camera(), (0.5, 0.5, 0.5, 0.7, 0.7)))
    assert len(list(job_frames(job))) == 5
    assert motion.calls == 2


def test_what_never_moves_looks_the_same_at_all_times() -> None:
    frames = list(job_frames(RenderJob(still_scene(), static_path(camera(), (0.0, 0.5, 1.0)))))
    assert all(np.array_equal(frame.rgb, frames[0].rgb) for frame in frames)
