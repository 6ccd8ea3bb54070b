"""Motions: saved and read exactly, resampled, cut to the joints of a body, and read by suffix."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_files import random_motion, tiny_body
from scipy.spatial.transform import Rotation

from dyngs.errors import DyngsError
from dyngs.human.motion.motion import (
    MAX_JOINT_POSES,
    Motion,
    frame_chunks,
    require_frame_count,
    require_frame_rate,
    sample_times,
)
from dyngs.human.template.joints import SMPLX_ROWS

BODY = tiny_body()


def matrices(motion: Motion) -> np.ndarray:
    return Rotation.from_rotvec(motion.poses.double().numpy().reshape(-1, 3)).as_matrix()


# --- files ------------------------------------------------------------------------------------------------------------


# --- joints and times -------------------------------------------------------------------------------------------------


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
    np.testing.assert_allclose(matrices(down), matrices(replace(motion, poses=motion.poses[::step])), atol=1e-6)
    up = motion.resampled(fps * step)
    assert len(up) == (frames - 1) * step + 1
    back = up.resampled(fps)
    torch.testing.assert_close(back.trans, motion.trans)
    np.testing.assert_allclose(matrices(back), matrices(motion), atol=1e-5)


def test_between_frames() -> None:
    """A turn by 3 rad and back over the shorter way, at constant speed; positions and scales on a line."""
    poses = torch.zeros(2, 55, 3)
    poses[:, 3, 2] = torch.tensor([3.0, -3.0])
    motion = Motion(poses, torch.tensor([[0.0, 0, 0], [4, 0, 0]]), torch.zeros(10), 1.0, torch.tensor([1.0, 2]))
    found = motion.resampled(4.0)
    gap = 2 * np.pi - 6
    angles = Rotation.from_rotvec(found.poses[:, 3].double().numpy()).as_euler("xyz")[:, 2] % (2 * np.pi)
    np.testing.assert_allclose(angles, 3 + gap * np.linspace(0, 1, 5), atol=1e-6)
    assert found.trans[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert found.scale.tolist() == [1, 1.25, 1.5, 1.75, 2]
    assert found.fps == 4.0
    assert len(motion.resampled(0.1)) == 1


def test_times_that_float32_rounds_down_keep_their_last_frame() -> None:
    assert [len(sample_times(float(np.float32(k / 30)), 1.0, 30.0)) for k in range(500)] == list(range(1, 501))


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan"), float("inf"), 1e9])
def test_rates_that_make_no_sense(fps: float) -> None:
    with pytest.raises(DyngsError, match="ask for 30 or the like"):
        random_motion().resampled(fps)


# --- limits -----------------------------------------------------------------------------------------------------------


def test_motions_that_fill_the_memory_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of few joints too, as the body has 55."""
    require_frame_count(Path("x.glb"), MAX_JOINT_POSES // 100, 100)
    for frames, joints in ((MAX_JOINT_POSES // 100 + 1, 100), (MAX_JOINT_POSES // 55 + 1, 1), (float("inf"), 1)):
        with pytest.raises(DyngsError, match=r"x\.glb: .* too many; at most 5,000,000 .* or set .* DYNGS_LIMITS="):
            require_frame_count(Path("x.glb"), frames, joints)
    monkeypatch.setenv("DYNGS_LIMITS", "2")
    require_frame_count(Path("x.glb"), 2 * MAX_JOINT_POSES // 100, 100)


def test_resampling_has_the_same_limit() -> None:
    motion = replace(random_motion(), fps=1e-3)
    with pytest.raises(DyngsError, match=r"more than 90,909 frames; ask for 30 or the like, or set DYNGS_LIMITS=N"):
        motion.resampled(30.0)


@pytest.mark.parametrize("fps", [0.0, 1e-310, 1e-9, 1e6, float("inf"), float("nan")])
def test_rates_of_no_motion(fps: float) -> None:
    with pytest.raises(DyngsError, match=r"x\.bvh: .* frames per second is not the rate of a motion"):
        require_frame_rate(Path("x.bvh"), fps)


def test_long_motions_are_worked_on_in_parts() -> None:
    """As if they were not."""
    motion = random_motion(2500)
    whole, parts = motion.resampled(24.0), frame_chunks(2500)
    assert [(part.start, part.stop) for part in parts] == [(0, 1024), (1024, 2048), (2048, 2500)]
    expected = motion._interpolated(sample_times(2499, 30.0, 24.0), 24.0)
    for name in ("poses", "trans", "scale"):
        torch.testing.assert_close(getattr(whole, name), getattr(expected, name))
