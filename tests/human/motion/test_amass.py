"""AMASS files: every layout, both up axes, and broken files that end in one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from motion_files import random_motion, slow_vertices, tiny_body
from scipy.spatial.transform import Rotation

from dyngs.core.errors import DyngsError
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.motion.amass import read_amass, write_amass
from dyngs.human.motion.motion import Motion, UpAxis

SHARED = Path(__file__).parents[3] / "../shared/data"
BODY = tiny_body()
Y_FROM_Z = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
FRAMES = 4


def numbers(count: int = 55, **changes: Any) -> dict[str, object]:
    """Return the arrays of a file for a body of ``count`` joints."""
    motion = random_motion(FRAMES)
    return {
        "poses": motion.for_joints(count).poses.reshape(FRAMES, -1).numpy().astype(np.float64),
        "trans": motion.trans.numpy().astype(np.float64),
        "betas": np.linspace(-1, 1, 16),
        "gender": np.array("neutral"),
        "mocap_framerate": np.array(120.0),
        "dmpls": np.zeros((FRAMES, 8)),
        **changes,
    }


def read(
    path: Path, arrays: dict[str, object], count: int = 55, up: UpAxis = "auto", shapes: int = 0
) -> Motion:
    given = {key: np.asarray(value) for key, value in arrays.items() if value is not None}
    np.savez(path / "x.npz", **given)  # pyright: ignore[reportArgumentType]
    return read_amass(path / "x.npz", tiny_body(count, shapes), up)


def as_written(arrays: dict[str, object], count: int, scale: float = 1.0) -> Motion:
    """Return the motion that a file stores, in the world frame of the file."""
    poses = torch.zeros(FRAMES, 55, 3)
    rows = {24: range(22), 52: [*range(22), *range(25, 55)], 55: range(55)}[count]
    flat = torch.tensor(np.asarray(arrays["poses"])).float().reshape(FRAMES, -1, 3)
    poses[:, list(rows)] = flat[:, : len(rows)]
    trans, betas = (torch.tensor(np.asarray(arrays[key])).float() for key in ("trans", "betas"))
    return Motion(poses, trans, betas, 120.0, torch.full((FRAMES,), scale))


# --- up axis
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [24, 52, 55])
@pytest.mark.parametrize("shapes", [0, 10, 16])
def test_z_up_files_are_turned_vertex_by_vertex(tmp_path: Path, count: int, shapes: int) -> None:
    """(x, y, z) becomes (x, z, -y) for all that is skinned, with the pelvis of the shaped body."""
    arrays = numbers(count)
    body = tiny_body(count, shapes)
    expected = slow_vertices(body, as_written(arrays, count)) @ Y_FROM_Z.T
    motion = read(tmp_path, arrays, count, shapes=shapes)
    np.testing.assert_allclose(slow_vertices(body, motion), expected, atol=2e-6)
    assert len(motion.betas) == shapes


@pytest.mark.parametrize(
    ("changes", "up", "is_turned"),
    [
        ({}, "auto", True),
        ({}, "y", False),
        ({}, "z", True),
        ({"scale": 1.0}, "auto", False),
        ({"scale": 1.0}, "z", True),
        ({"up_axis": "y"}, "auto", False),
        ({"up_axis": "z", "scale": 1.0}, "auto", True),
        ({"up_axis": "z"}, "y", False),
    ],
)
def test_which_files_are_turned(
    tmp_path: Path, changes: dict[str, Any], up: UpAxis, is_turned: bool
) -> None:
    """AMASS's are; those with a scale, which fits of our own write, are not; the file's word counts
    more, the caller's most."""
    arrays = numbers(**changes)
    motion = read(tmp_path, arrays, up=up)
    plain = as_written(arrays, 55)
    assert torch.equal(motion.poses[:, 1:], plain.poses[:, 1:])
    assert torch.equal(motion.poses[:, 0], plain.poses[:, 0]) == (not is_turned)
    assert torch.equal(motion.trans, plain.trans) == (not is_turned)


# --- layouts
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [24, 52, 55])
def test_joints_of_every_width(tmp_path: Path, count: int) -> None:
    """Fingers go to their positions; the hands of SMPL are left out; what is not there does not
    turn."""
    arrays = numbers(count, up_axis="y")
    motion = read(tmp_path, arrays, count)
    assert motion.poses.shape == (FRAMES, 55, 3)
    assert motion.poses.dtype == motion.trans.dtype == torch.float32
    written = dict(zip(JOINT_NAMES, random_motion(FRAMES).poses.unbind(1), strict=True))
    for i, name in enumerate(JOINT_NAMES):
        is_there = (
            i < 22
            or (count == 55)
            or (count == 52 and name not in ("jaw", "left_eye", "right_eye"))
        )
        assert torch.equal(
            motion.poses[:, i], written[name] if is_there else torch.zeros(FRAMES, 3)
        ), name


@pytest.mark.parametrize("left_out", [(), ("pose_hand",), ("pose_jaw", "pose_eye", "pose_hand")])
def test_parts_instead_of_poses(tmp_path: Path, left_out: tuple[str, ...]) -> None:
    """Root 3, body 63, jaw 3, eyes 6, hands 90, as SMPL-X joins them; missing ones do not turn."""
    arrays = numbers(up_axis="y")
    flat = np.asarray(arrays.pop("poses"))
    cuts = {
        "root_orient": (0, 3),
        "pose_body": (3, 66),
        "pose_jaw": (66, 69),
        "pose_eye": (69, 75),
        "pose_hand": (75, 165),
    }
    parts = {key: flat[:, a:b] for key, (a, b) in cuts.items() if key not in left_out}
    expected = flat.copy()
    for key in left_out:
        expected[:, slice(*cuts[key])] = 0
    np.testing.assert_array_equal(
        read(tmp_path, {**arrays, **parts}).poses.reshape(FRAMES, -1).numpy(),
        expected.astype(np.float32),
    )


def test_the_motions_at_hand() -> None:
    """Feet on the floor, head up: they are y up."""
    folder = SHARED / "body" / "motions"
    if not folder.is_dir():
        pytest.skip("the motions of ../shared/data are not here")
    for path in [*folder.glob("*.npz"), *(SHARED / "human").glob("*/body_*.npz")]:
        motion = read_amass(path, tiny_body())
        with np.load(path) as file:
            np.testing.assert_array_equal(
                motion.poses.reshape(len(motion), -1).numpy(), file["poses"]
            )
            np.testing.assert_array_equal(motion.trans.numpy(), file["trans"])
            assert motion.fps == file["mocap_frame_rate"]
            assert float(motion.scale[0]) == pytest.approx(float(file["scale"]))


# --- files with the names of the package smplx
# ------------------------------------------------------------------------


def named(**changes: Any) -> dict[str, object]:
    """The same numbers under the names that fits to videos have."""
    poses = np.asarray(numbers()["poses"])
    widths = {"global_orient": 3, "body_pose": 63, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3}
    widths |= {"left_hand_pose": 45, "right_hand_pose": 45}
    ends = np.cumsum(list(widths.values()))
    parts = {
        key: poses[:, end - width : end]
        for (key, width), end in zip(widths.items(), ends, strict=True)
    }
    return {
        **parts,
        "transl": numbers()["trans"],
        "betas": np.ones((FRAMES, 10)),
        "fps": 25,
        **changes,
    }


UPS = {
    "y": np.eye(3),
    "z": Y_FROM_Z,
    "-y": np.diag([1.0, -1, -1]),
    "x": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}


@pytest.mark.parametrize("axis", UPS)
def test_fits_are_turned_so_that_the_pelvis_is_upright(tmp_path: Path, axis: str) -> None:
    """Vertex by vertex, whichever axis of the fit is up: its cameras decide that."""
    y_from_file = UPS[axis]
    body = tiny_body(55, 10)
    given = named()
    roots = Rotation.from_rotvec(0.2 * np.asarray(given["global_orient"]))
    given["global_orient"] = (Rotation.from_matrix(y_from_file.T) * roots).as_rotvec()
    flat = np.concatenate(
        [np.asarray(x) for key, x in given.items() if "pose" in key or "orient" in key], axis=1
    )
    arrays = {"poses": flat, "trans": given["transl"], "betas": np.ones(10)}
    expected = slow_vertices(body, as_written(arrays, 55)) @ y_from_file.T
    motion = read(tmp_path, given, shapes=10)
    np.testing.assert_allclose(slow_vertices(body, motion), expected, atol=3e-6)
    assert motion.fps == 25
    chosen = read(tmp_path, {**given, "up_axis": "y"}, shapes=10)
    np.testing.assert_allclose(chosen.trans.numpy(), np.asarray(given["transl"]), atol=1e-6)


# --- files of other programs
# -----------------------------------------------------------------------------------------

WALK = np.linspace([0, 1, 0], [0.02, 1, 0.01], FRAMES)  # at a speed of people
SMPL = numbers(24, trans=WALK, betas=np.linspace(-1, 1, 10))
ROTVECS = np.asarray(SMPL["poses"]).reshape(FRAMES, 24, 3)
MATRICES = Rotation.from_rotvec(ROTVECS.reshape(-1, 3)).as_matrix().reshape(FRAMES, 24, 3, 3)
SHAPES = np.asarray(SMPL["betas"])


@pytest.mark.parametrize(
    "changes",
    [
        {"poses": ROTVECS},
        {"poses": MATRICES},
        {"trans": WALK[:, None], "betas": SHAPES[None, None]},
        {"betas": SHAPES[None]},
        {"betas": np.repeat(SHAPES[None], FRAMES, 0)},
        {"mocap_framerate": np.full((FRAMES, 1), 120)},
        {"mocap_framerate": b"120"},
        {"mocap_framerate": "120.0"},
    ],
)
def test_layouts_of_the_same_motion(tmp_path: Path, changes: dict[str, object]) -> None:
    """Rows of joints, rotation matrices, a batch of one, shapes per frame, rates as text: the
    values are the same."""
    plain = read(tmp_path, SMPL, 24, shapes=10)
    other = read(tmp_path, SMPL | changes, 24, shapes=10)
    for name in ("poses", "trans", "betas"):
        np.testing.assert_allclose(
            getattr(other, name), getattr(plain, name), atol=1e-6, err_msg=name
        )
    assert other.fps == 120
    assert other.notes == ()


@pytest.mark.parametrize("as_matrices", [False, True])
def test_files_of_romp_and_hmr(tmp_path: Path, as_matrices: bool) -> None:
    """In the axes of a camera, y down: upright as the same numbers with the names of smplx are."""
    down = Rotation.from_rotvec([np.pi, 0, 0])
    rotvecs = ROTVECS.copy()
    rotvecs[:, 0] = (down * Rotation.from_rotvec(0.2 * ROTVECS[:, 0])).as_rotvec()
    parts = {"global_orient": rotvecs[:, 0], "body_pose": rotvecs[:, 1:].reshape(FRAMES, -1)}
    rest = {"smpl_betas": SHAPES[None], "cam_trans": WALK, "fps": 25}
    if as_matrices:
        matrices = (
            Rotation.from_rotvec(rotvecs.reshape(-1, 3)).as_matrix().reshape(FRAMES, 24, 3, 3)
        )
        parts = {"global_orient": matrices[:, :1], "body_pose": matrices[:, 1:]}
    body = tiny_body(24, 10)
    stored = as_written({"poses": rotvecs, "trans": WALK, "betas": SHAPES}, 24)
    expected = slow_vertices(body, stored) @ np.diag([1.0, -1, -1])
    motion = read(tmp_path, parts | rest, 24, shapes=10)
    np.testing.assert_allclose(slow_vertices(body, motion), expected, atol=3e-6)
    assert len(motion.notes) == 1
    assert "no up axis in the file; using -y" in motion.notes[0]
    thetas = read(tmp_path, {"smpl_thetas": rotvecs} | rest, 24, shapes=10)
    np.testing.assert_allclose(thetas.poses, motion.poses, atol=1e-6)


# --- broken files
# ----------------------------------------------------------------------------------------------

NAN = np.full((FRAMES, 3), np.nan)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"poses": None}, "'root_orient' is missing"),
        ({"poses": None, "root_orient": np.zeros((4, 3))}, "'pose_body' is missing"),
        (
            {"poses": np.zeros((4, 96))},
            "'poses' must hold .* 22 or 24 or 52 or 55 joints .*, got shape 4 x 96; .*quaternions",
        ),
        ({"poses": np.zeros((4, 24, 6))}, "'poses' must hold .*, got shape 4 x 24 x 6; .*6D"),
        (
            {"poses": np.full((4, 72), 30.0)},
            "a joint rotates by 52 rad, more than two turns; convert degrees",
        ),
        ({"poses": np.full((4, 165), "a")}, "'poses' must hold numbers, not <U1"),
        (
            {"poses": np.array([{}], object)},
            "'poses': cannot be read .*it holds Python objects",
        ),
        ({"trans": None}, "the key 'trans' is missing"),
        ({"trans": NAN}, "'trans' holds NaN"),
        (
            {"trans": np.zeros((3, 3))},
            "cannot be read",
        ),
        ({"mocap_framerate": None}, "has no frame rate; .*dyngs data motion FILE OUT.npz --fps 30"),
        ({"mocap_framerate": 0.0}, "is outside 0.001 to 100,000"),
        ({"mocap_framerate": b"fast"}, "could not convert"),
        ({"scale": -1.0}, "'scale' must be positive"),
        ({"scale": np.ones(3)}, "cannot be read"),
        (
            {"poses": np.zeros((90_910, 72), np.uint8)},
            "90910 frames of 55 joints exceed the limit of 5,000,000 joint poses",
        ),
        (
            {"up_axis": np.frombuffer(b"\xff" * 4, "<U1")},
            "'up_axis': cannot be read .*invalid characters",
        ),
        ({"up_axis": ["y", "z"]}, "'up_axis' must be 'y' or 'z', not"),
        ({"up_axis": "x"}, "'up_axis' must be 'y' or 'z', not 'x'"),
        (
            {"poses": None, "root_orient": np.zeros((4, 3)), "pose_body": np.zeros((4, 60))},
            "'pose_body' must hold .*, got shape 4 x 60",
        ),
    ],
)
def test_broken_files_say_what_is_wrong(
    tmp_path: Path, changes: dict[str, object], problem: str
) -> None:
    with pytest.raises(DyngsError, match=problem) as caught:
        read(tmp_path, numbers() | changes)
    assert str(caught.value).startswith(str(tmp_path / "x.npz"))
    assert "\n" not in str(caught.value)


# --- writing
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fps", [30.0, 29.97, 1 / 3])
def test_saved_motions_are_read_exactly(tmp_path: Path, fps: float) -> None:
    """Motions are read exactly on any body, and the same motion is written to the same bytes."""
    motion = replace(random_motion(), fps=fps, betas=torch.randn(7), scale=torch.rand(4) + 0.1)
    write_amass(motion, tmp_path / "new" / "x.npz")
    for body in (BODY, tiny_body(24)):
        found = read_amass(tmp_path / "new" / "x.npz", body)
        for name in ("poses", "trans", "betas", "scale"):
            assert torch.equal(getattr(found, name), getattr(motion, name)), name
        assert found.fps == fps
    write_amass(found, tmp_path / "y.npz")
    assert (tmp_path / "y.npz").read_bytes() == (tmp_path / "new" / "x.npz").read_bytes()
