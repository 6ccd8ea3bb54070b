"""Body parameters: checks, changes of frame, fitted files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import (
    attach_fitted_body,
    build_body_frames,
    merge_root_rotation,
)
from dyngs.data.capture import BodyFrames, Capture
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
FILE = Path("body.npz")


def posed(
    points: np.ndarray, joints: np.ndarray, weights: np.ndarray, pose: np.ndarray
) -> np.ndarray:
    """(M, 3) linear blend skinning, one joint after the other: ``v = sum_j w_j A_j v``."""
    to_world: list[np.ndarray] = []
    total = np.zeros_like(points)
    for joint, parent in enumerate(PARENTS):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(pose[joint]).as_matrix()
        step[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        to_world.append(step if parent < 0 else to_world[parent] @ step)
        turned = (points - joints[joint]) @ to_world[joint][:3, :3].T + to_world[joint][:3, 3]
        total += weights[:, joint, None] * turned
    return total


def random_body(seed: int, count: int = 3, turned: bool = True) -> BodyFrames:
    rng = np.random.default_rng(seed)
    return BodyFrames(
        frames=tuple(range(count)),
        poses=rng.normal(size=(count, 24, 3)),
        trans=rng.normal(size=(count, 3)),
        betas=np.zeros(10),
        scale=rng.uniform(0.2, 3, count),
        origin_rotations=rng.normal(size=(count, 3)) * 2 if turned else None,
    )


def in_world(
    body: BodyFrames, row: int, points: np.ndarray, joints: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Return the template points in world coordinates, by the definition of ``BodyFrames``."""
    at_rest = posed(points, joints, weights, body.poses[row])
    if body.origin_rotations is not None:
        at_rest = at_rest @ Rotation.from_rotvec(body.origin_rotations[row]).as_matrix().T
    return body.scale[row] * at_rest + body.trans[row]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000))
def test_turns_about_the_origin_become_turns_about_the_pelvis(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(8, 3))
    joints = rng.normal(size=(24, 3))
    weights = rng.dirichlet(np.ones(24), 8)
    body = random_body(seed)
    same = merge_root_rotation(body, joints[0])
    assert same.origin_rotations is None
    for row in range(3):
        expected = in_world(body, row, points, joints, weights)
        np.testing.assert_allclose(
            in_world(same, row, points, joints, weights), expected, atol=1e-11
        )


def test_rows_in_any_order_and_shape() -> None:
    poses = np.arange(3 * 165.0).reshape(3, 1, 165)
    trans = np.arange(9.0).reshape(3, 1, 3)
    body = build_body_frames(FILE, [7, 2, 5], poses, trans, np.ones((3, 10)) * [[0], [1], [2]], 2.0)
    assert (body.frames, body.kind, body.betas.tolist(), body.scale.tolist()) == (
        (2, 5, 7),
        "smplx",
        [1] * 10,
        [2] * 3,
    )
    assert body.poses.shape == (3, 55, 3)
    assert body.poses[:, 0, 0].tolist() == [165, 330, 0]
    assert body.trans[:, 0].tolist() == [3, 6, 0]
    kinds = [
        build_body_frames(FILE, [0], np.zeros((1, w)), [[0, 0, 0]], [0.0]).kind
        for w in (72, 156, 165)
    ]
    assert kinds == ["smpl", "smplh", "smplx"]


GOOD: dict[str, Any] = {
    "frames": range(4),
    "poses": np.zeros((4, 72)),
    "trans": np.zeros((4, 3)),
    "betas": np.zeros(10),
    "scale": np.ones(4),
}


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            {"poses": np.zeros((4, 87))},
            "'poses' has 87 numbers per frame; supported bodies: 72",
        ),
        ({"poses": np.zeros((4, 73))}, "'poses' has 73 numbers per frame"),
        ({"poses": np.zeros((3, 72))}, "'poses' must have one row of numbers for each of 4 frames"),
        ({"poses": np.zeros(())}, "'poses' must have one row of numbers"),
        ({"poses": [[0.0] * 72] * 3 + [[0.0]]}, "'poses' must have one row of numbers"),
        ({"poses": [["a"] * 72] * 4}, "'poses' must have one row of numbers"),
        ({"trans": np.zeros((4, 4))}, "'trans' has 4 numbers per frame instead of 3"),
        ({"trans": np.full((4, 3), np.nan)}, "'trans' of frame 0 contains NaN"),
        (
            {"trans": np.full((4, 3), 1e39)},
            "'trans' of frame 0 contains NaN, infinite or huge values",
        ),
        (
            {"poses": np.where(np.arange(4)[:, None] == 2, np.inf, np.zeros(72))},
            "'poses' of frame 2 contains NaN",
        ),
        ({"betas": [0, np.nan]}, "'betas' must hold finite numbers"),
        ({"betas": [0, 1e39]}, "'betas' must hold finite numbers"),
        ({"betas": np.zeros((3, 10))}, "'betas' must have one row of numbers"),
        ({"scale": -np.ones(4)}, "'scale' must be positive"),
        ({"scale": "big"}, "'scale' must have one row of numbers"),
        (
            {"origin_rotations": np.zeros((4, 4))},
            "'origin_rotations' has 4 numbers per frame instead of 3",
        ),
        ({"frames": [0, 1, 2, 1]}, "frame 1 has two sets of body parameters"),
        ({"frames": []}, "no frames found"),
    ],
)
def test_bad_parameters(change: dict[str, Any], line: str) -> None:
    assert build_body_frames(FILE, **GOOD).frames == (0, 1, 2, 3)
    with pytest.raises(DyngsError, match=line) as caught:
        build_body_frames(FILE, **{**GOOD, **change})
    assert "body.npz" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    options = HumanOptions(
        size=16, num_frames=3, num_pose_frames=2, num_cameras=2, num_test=1, samples=1
    )
    return read_capture(
        DataConfig(root=write_human_capture(tmp_path_factory.mktemp("body") / "person", options))
    )


def write(path: Path, count: int = 3, **more: np.ndarray) -> Path:
    rows = np.arange(count, dtype=np.float64)[:, None]
    np.savez(
        path, poses=np.zeros((count, 165)), trans=rows * np.ones(3), betas=np.zeros(44), **more
    )
    return path


def test_a_fit_replaces_the_bodies_of_a_capture(capture: Capture, tmp_path: Path) -> None:
    write(tmp_path / "body_train.npz", surface_model_type=np.array("anny"))
    found = attach_fitted_body(capture, tmp_path)
    assert found.body is not None
    assert found.body["train"].shape_space == "anny"
    assert found.body["test"] is found.body["train"]
    assert "pose" not in found.splits, "no parameters for the other clip"
    write(tmp_path / "body_pose.npz", count=2)
    assert "pose" in attach_fitted_body(capture, tmp_path).splits


def test_a_capture_is_read_with_the_fit_that_the_options_name(
    capture: Capture, tmp_path: Path
) -> None:
    write(tmp_path / "body_train.npz")
    found = read_capture(DataConfig(root=capture.root, body=tmp_path))
    assert found.body is not None
    assert found.body["train"].trans[:, 0].tolist() == [0, 1, 2]
    with pytest.raises(DyngsError, match=r"body_train\.npz: no such file.* to reuse a fit"):
        read_capture(DataConfig(root=capture.root, body=tmp_path / "elsewhere"))
