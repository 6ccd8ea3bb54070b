"""Motions: saved and read exactly, resampled, cut to the joints of a body, and read by suffix."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_files import random_motion
from scipy.spatial.transform import Rotation

from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import build_body_frames
from dyngs.data.capture import BodyFrames, View
from dyngs.human.body.joints import SMPLX_ROWS
from dyngs.human.motion.motion import (
    MAX_JOINT_POSES,
    Motion,
    MotionClip,
    captured_motion,
    require_frame_count,
)


def matrices(motion: Motion) -> np.ndarray:
    return Rotation.from_rotvec(motion.poses.double().numpy().reshape(-1, 3)).as_matrix()


# --- files
# ----------------------------------------------------------------------------------------------


# --- joints and times
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [24, 52, 55])
def test_joints_of_a_body(count: int) -> None:
    motion = random_motion()
    poses = motion.for_joints(count).poses
    assert poses.shape == (4, count, 3)
    for i, row in enumerate(SMPLX_ROWS[count]):
        assert torch.equal(poses[:, i], motion.poses[:, row])
    assert not poses[:, len(SMPLX_ROWS[count]) :].any()


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 40), st.sampled_from([24.0, 25.0, 30.0, 120.0]), st.integers(1, 8))
def test_every_nth_frame(frames: int, fps: float, step: int) -> None:
    """Down: those very frames. Up: they are still there, and going back gives the motion."""
    motion = replace(random_motion(frames), fps=fps)
    down = motion.resampled(fps / step)
    torch.testing.assert_close(down.trans, motion.trans[::step])
    np.testing.assert_allclose(
        matrices(down), matrices(replace(motion, poses=motion.poses[::step])), atol=1e-6
    )
    up = motion.resampled(fps * step)
    assert len(up) == (frames - 1) * step + 1
    back = up.resampled(fps)
    torch.testing.assert_close(back.trans, motion.trans)
    np.testing.assert_allclose(matrices(back), matrices(motion), atol=1e-5)


def test_between_frames() -> None:
    """A turn by 3 rad and back over the shorter way, at constant speed; positions and scales on a
    line."""
    poses = torch.zeros(2, 55, 3)
    poses[:, 3, 2] = torch.tensor([3.0, -3.0])
    motion = Motion(
        poses, torch.tensor([[0.0, 0, 0], [4, 0, 0]]), torch.zeros(10), 1.0, torch.tensor([1.0, 2])
    )
    found = motion.resampled(4.0)
    gap = 2 * np.pi - 6
    angles = Rotation.from_rotvec(found.poses[:, 3].double().numpy()).as_euler("xyz")[:, 2] % (
        2 * np.pi
    )
    np.testing.assert_allclose(angles, 3 + gap * np.linspace(0, 1, 5), atol=1e-6)
    assert found.trans[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert found.scale.tolist() == [1, 1.25, 1.5, 1.75, 2]
    assert found.fps == 4.0
    assert len(motion.resampled(0.1)) == 1


# --- limits
# ----------------------------------------------------------------------------------------------


def test_motions_that_fill_the_memory_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of few joints too, as the body has 55."""
    require_frame_count(Path("x.glb"), MAX_JOINT_POSES // 100, 100)
    for frames, joints in (
        (MAX_JOINT_POSES // 100 + 1, 100),
        (MAX_JOINT_POSES // 55 + 1, 1),
        (float("inf"), 1),
    ):
        with pytest.raises(
            DyngsError, match=r"x\.glb: .* exceed the limit of 5,000,000 .* or set DYNGS_LIMITS="
        ):
            require_frame_count(Path("x.glb"), frames, joints)
    monkeypatch.setenv("DYNGS_LIMITS", "2")
    require_frame_count(Path("x.glb"), 2 * MAX_JOINT_POSES // 100, 100)


def three_frames() -> MotionClip:
    poses = torch.zeros(3, 2, 3)
    poses[1, 1, 2], poses[2, 1, 2] = 0.5, 3.0
    trans = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0]])
    return MotionClip(
        torch.tensor([0.0, 0.25, 1.0], dtype=torch.float64),
        poses,
        trans,
        torch.tensor([1.0, 1.0, 2.0]),
    )


def test_a_clip_is_exact_at_its_frames_and_turns_evenly_between() -> None:
    clip = three_frames()
    for row, time in enumerate(clip.times.tolist()):
        torch.testing.assert_close(clip.at(time).poses[0], clip.poses[row], rtol=0, atol=0)
        torch.testing.assert_close(clip.at(time).trans[0], clip.trans[row], rtol=0, atol=0)
    between = clip.at(0.625)
    assert float(between.poses[0, 1, 2]) == pytest.approx(1.75)
    assert float(between.trans[0, 0]) == pytest.approx(3.0)
    assert float(between.scale[0]) == pytest.approx(1.5)


WHERE = Path("capture")


def bodies(frames: list[int], joints: int = 55) -> BodyFrames:
    rows = len(frames)
    poses = np.random.default_rng(0).uniform(-1, 1, (rows, joints * 3))
    return build_body_frames(
        WHERE, frames, poses, np.arange(3 * rows).reshape(rows, 3), np.zeros(10)
    )


def view(frame: int, time: float | None) -> View:
    return View(f"v{frame}", Path("x.png"), np.eye(4), np.eye(3), 4, 4, time=time, frame=frame)


def test_a_captured_motion_has_the_frames_that_views_show_in_order_of_time() -> None:
    given = bodies([3, 4, 7, 9])
    filmed = captured_motion(
        WHERE, given, [view(9, 1.0), view(3, 0.0), view(7, 0.5), view(3, 0.0)], torch.zeros(55, 3)
    )
    assert filmed.frames == (3, 7, 9)
    assert filmed.clip.times.tolist() == [0.0, 0.5, 1.0]
    np.testing.assert_allclose(filmed.clip.trans.numpy(), given.trans[[0, 2, 3]])
    np.testing.assert_allclose(filmed.clip.poses.numpy(), given.poses[[0, 2, 3]], rtol=1e-6)


def test_a_static_person_has_one_pose_for_all_frames() -> None:
    """A person who moves, or turns one joint, has one pose per frame."""
    given = bodies([3, 4, 7])
    given.poses[:], given.trans[:] = given.poses[0], given.trans[0]
    views = [view(3, 0.0), view(4, 0.5), view(7, 1.0)]
    still = captured_motion(WHERE, given, views, torch.zeros(55, 3))
    assert len(still.clip) == 1
    assert still.rows == {3: 0, 4: 0, 7: 0}
    np.testing.assert_allclose(still.clip.at(0.7).trans[0].numpy(), given.trans[0])
    given.poses[1, 4, 0] += 1e-3
    moving = captured_motion(WHERE, given, views, torch.zeros(55, 3))
    assert len(moving.clip) == 3
    assert moving.rows == {3: 0, 4: 1, 7: 2}


def test_a_view_without_parameters_is_named() -> None:
    with pytest.raises(DyngsError, match="no body parameters for 1 frames that have images"):
        captured_motion(WHERE, bodies([0, 1]), [view(5, 0.0)], torch.zeros(55, 3))
