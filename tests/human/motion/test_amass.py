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
MODELS = {24: "smpl", 52: "smplh", 55: "smplx"}
Y_FROM_Z = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
FRAMES = 4


def numbers(count: int = 55, **changes: Any) -> dict[str, object]:
    """The arrays of a file for a body of so many joints."""
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
    """What the file says, in its own world."""
    poses = torch.zeros(FRAMES, 55, 3)
    rows = {24: range(22), 52: [*range(22), *range(25, 55)], 55: range(55)}[count]
    flat = torch.tensor(np.asarray(arrays["poses"])).float().reshape(FRAMES, -1, 3)
    poses[:, list(rows)] = flat[:, : len(rows)]
    trans, betas = (torch.tensor(np.asarray(arrays[key])).float() for key in ("trans", "betas"))
    return Motion(poses, trans, betas, 120.0, torch.full((FRAMES,), scale))


# --- up axis
# ----------------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_turning_heeds_the_scale(tmp_path: Path, scale: float) -> None:
    arrays = numbers(scale=scale)
    expected = slow_vertices(tiny_body(), as_written(arrays, 55, scale)) @ Y_FROM_Z.T
    motion = read(tmp_path, arrays, up="z")
    np.testing.assert_allclose(slow_vertices(tiny_body(), motion), expected, atol=4e-6)
    assert motion.scale.tolist() == [scale] * FRAMES


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


def test_motions_of_another_body_land_on_the_floor(tmp_path: Path) -> None:
    """A file of SMPL-H on SMPL-X: its pelvis lies elsewhere, and its shape means nothing here."""
    body = tiny_body(55, 10)
    motion = read(tmp_path, numbers(52), 55, shapes=10)
    assert slow_vertices(body, motion)[..., 1].min() == pytest.approx(0, abs=1e-6)
    assert not motion.betas.any()
    exact = read(tmp_path, numbers(55), 55, shapes=10)
    assert abs(slow_vertices(body, exact)[..., 1].min()) > 0.01
    assert exact.betas.any()


def test_own_files_stay_where_they_are_on_any_body(tmp_path: Path) -> None:
    arrays = numbers(scale=0.9)
    motion = read(tmp_path, arrays, 24)
    assert torch.equal(motion.trans, as_written(arrays, 55).trans)


# --- layouts
# ----------------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("key", ["mocap_framerate", "mocap_frame_rate"])
def test_both_names_of_the_frame_rate(tmp_path: Path, key: str) -> None:
    assert read(tmp_path, numbers(mocap_framerate=None) | {key: np.array(59.94)}).fps == 59.94


def test_a_file_without_shape(tmp_path: Path) -> None:
    assert read(tmp_path, numbers(betas=None, up_axis="y")).betas.tolist() == [0.0] * 10


def test_scales_per_frame(tmp_path: Path) -> None:
    assert read(tmp_path, numbers(scale=np.arange(1.0, 5.0))).scale.tolist() == [1, 2, 3, 4]


def test_objects_beside_the_numbers_are_not_touched(tmp_path: Path) -> None:
    """Some releases hold labels as Python objects."""
    assert len(read(tmp_path, numbers(labels=np.array([{"a": 1}, None], dtype=object)))) == FRAMES


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


def test_what_fits_may_lack_and_spell_otherwise(tmp_path: Path) -> None:
    """Parts after the body, rows of joints, SMPL's 23 joints, one more axis."""
    whole = named()
    short = {
        key: x for key, x in whole.items() if key in ("global_orient", "body_pose", "transl", "fps")
    }
    body = np.asarray(whole["body_pose"])
    padded = {**short, "body_pose": np.concatenate([body, np.ones((FRAMES, 6))], axis=1)}
    rows = {
        **short,
        "body_pose": body.reshape(FRAMES, 21, 3),
        "global_orient": np.asarray(short["global_orient"])[:, None],
    }
    first = read(tmp_path, short)
    np.testing.assert_allclose(first.poses[:, 1:22].reshape(FRAMES, -1).numpy(), body, atol=1e-6)
    assert not bool(first.poses[:, 22:].any())
    for other in (padded, rows):
        np.testing.assert_array_equal(read(tmp_path, other).poses.numpy(), first.poses.numpy())


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        (
            {"left_hand_pose": np.zeros((4, 6))},
            "'left_hand_pose' must hold .* of 15 joints per frame, has 4 x 6;.*use_pca",
        ),
        ({"body_pose": None}, "the key 'body_pose' is missing"),
        (
            {"body_pose": np.zeros((4, 21, 3, 3))},
            "'body_pose' must hold .* 21 or 23 joints .*has 4 x 21 x 3 x 3;",
        ),
        ({"transl": None}, "the key 'trans' is missing"),
        ({"fps": None}, "has no frame rate; .*dyngs data motion FILE OUT.npz --fps 30"),
        ({"global_orient": np.float64(1)}, "'global_orient' must hold .*has one number"),
        (
            {"global_orient": np.zeros((3, 3))},
            "'body_pose' must have 3 frames as 'global_orient' has, has 4 x 63",
        ),
    ],
)
def test_broken_fits_say_what_is_wrong(
    tmp_path: Path, changes: dict[str, object], problem: str
) -> None:
    with pytest.raises(DyngsError, match=problem) as caught:
        read(tmp_path, named(**changes))
    assert str(caught.value).startswith(str(tmp_path / "x.npz"))
    assert "\n" not in str(caught.value)


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
        {"poses": MATRICES.reshape(FRAMES, -1)},
        {"poses": ROTVECS[None], "trans": WALK[None], "betas": SHAPES[None, None]},
        {"poses": ROTVECS.reshape(1, FRAMES, 72), "trans": WALK[:, None]},
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


def test_half_precision_and_the_22_joints_of_the_body(tmp_path: Path) -> None:
    """Any model has these joints, so the shape is dropped as that of another model."""
    halves = {key: np.asarray(SMPL[key]).astype(np.float16) for key in ("poses", "trans", "betas")}
    plain = read(tmp_path, SMPL, 24, shapes=10)
    np.testing.assert_allclose(
        read(tmp_path, SMPL | halves, 24, shapes=10).poses, plain.poses, atol=2e-3
    )
    halves["poses"] = MATRICES.astype(np.float16)
    np.testing.assert_allclose(
        read(tmp_path, SMPL | halves, 24, shapes=10).poses, plain.poses, atol=4e-3
    )
    body_only = read(tmp_path, SMPL | {"poses": ROTVECS[:, :22]}, 24, shapes=10)
    assert torch.equal(body_only.poses, plain.poses)
    assert not body_only.betas.any()


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
    assert "does not say what is up; -y is taken" in motion.notes[0]
    thetas = read(tmp_path, {"smpl_thetas": rotvecs} | rest, 24, shapes=10)
    np.testing.assert_allclose(thetas.poses, motion.poses, atol=1e-6)


@pytest.mark.parametrize(
    ("count", "said"), [(24, "the mean is taken"), (55, "dropped as the template is 'smplx'")]
)
def test_the_mean_of_shapes_per_frame(tmp_path: Path, count: int, said: str) -> None:
    betas = SHAPES + np.arange(FRAMES)[:, None]
    motion = read(tmp_path, SMPL | {"betas": betas}, count, shapes=10)
    np.testing.assert_allclose(motion.betas, (SHAPES + 1.5) * (count == 24), atol=1e-6)
    assert len(motion.notes) == 1
    assert "'betas' differ between frames by up to 3" in motion.notes[0]
    assert said in motion.notes[0]


def test_a_file_without_rate(tmp_path: Path) -> None:
    """The rate of the caller; a file that has one keeps it."""
    given = {key: value for key, value in SMPL.items() if key != "mocap_framerate"}
    np.savez(tmp_path / "y.npz", **given)  # pyright: ignore[reportArgumentType]
    motion = read_amass(tmp_path / "y.npz", tiny_body(24, 10), fps=12.5)
    plain = read(tmp_path, SMPL, 24, shapes=10)
    assert torch.equal(motion.poses, plain.poses)
    assert torch.equal(motion.trans, plain.trans)
    assert motion.fps == 12.5
    assert "z is taken, as in files of AMASS" in " ".join(motion.notes)
    assert read_amass(tmp_path / "x.npz", tiny_body(24, 10), fps=12.5).fps == 120
    for rate in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(DyngsError, match="is not the rate of a motion"):
            read_amass(tmp_path / "y.npz", tiny_body(24, 10), fps=rate)


def test_positions_in_millimetres(tmp_path: Path) -> None:
    """A walk of 1 m/s in millimetres is too fast for a person."""
    walk = np.linspace([0, 0, 0], [1, 0, 0], FRAMES) * 3 / 120
    assert read(tmp_path, SMPL | {"trans": walk}, 24).notes == ()
    (note,) = read(tmp_path, SMPL | {"trans": 1000 * walk}, 24).notes
    assert "the root moves at 1000 m/s" in note


# --- broken files
# -----------------------------------------------------------------------------------------------------

NAN = np.full((FRAMES, 3), np.nan)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"poses": None}, "has neither 'poses' nor 'root_orient'"),
        ({"poses": None, "root_orient": np.zeros((4, 3))}, "has neither 'poses' nor 'pose_body'"),
        (
            {"poses": np.zeros((4, 96))},
            "'poses' must hold .* 22 or 24 or 52 or 55 joints .*, has 4 x 96; .*quaternions",
        ),
        ({"poses": np.zeros((4, 24, 6))}, "'poses' must hold .*, has 4 x 24 x 6; .*6D"),
        ({"poses": np.zeros((4, 3, 24))}, "'poses' must hold .*, has 4 x 3 x 24"),
        ({"poses": np.zeros((2, 4, 72))}, "'poses' must hold .*, has 2 x 4 x 72"),
        ({"poses": np.full((4, 24, 3, 3), 0.5)}, "'poses' must hold .*, has 4 x 24 x 3 x 3"),
        (
            {"poses": -np.broadcast_to(np.eye(3), (4, 24, 3, 3))},
            "'poses' must hold .*, has 4 x 24 x 3 x 3",
        ),
        ({"poses": np.zeros(165)}, "'poses' must hold .* has 165"),
        (
            {"poses": np.full((4, 72), 30.0)},
            "a joint is rotated by 52 rad, more than two turns; convert degrees",
        ),
        ({"poses": np.zeros((0, 165)), "trans": np.zeros((0, 3))}, "has no frames"),
        ({"poses": np.full((4, 165), "a")}, "'poses' must hold numbers, not <U1"),
        ({"poses": np.full((4, 165), 1e30)}, "'poses' holds NaN or huge"),
        ({"poses": np.zeros((4, 165), complex)}, "'poses' must hold numbers"),
        (
            {"poses": np.array([{}], object)},
            "'poses': cannot be read .*it holds Python objects",
        ),
        ({"trans": None}, "the key 'trans' is missing"),
        ({"trans": NAN}, "'trans' holds NaN"),
        (
            {"trans": np.zeros((3, 3))},
            "'trans' must be 4 x 3 numbers as 'poses' has 4 frames, has 3 x 3",
        ),
        (
            {"trans": np.zeros((1, 3))},
            "'trans' must be 4 x 3 numbers as 'poses' has 4 frames, has 1 x 3",
        ),
        (
            {"trans": np.zeros((3, 4))},
            "'trans' must be 4 x 3 numbers as 'poses' has 4 frames, has 3 x 4",
        ),
        ({"mocap_framerate": None}, "has no frame rate; .*dyngs data motion FILE OUT.npz --fps 30"),
        ({"mocap_framerate": 0.0}, "'mocap_framerate' must be one positive number"),
        ({"mocap_framerate": [30.0, 25.0]}, "'mocap_framerate' must be one positive number"),
        ({"mocap_framerate": b"fast"}, "'mocap_framerate' must hold numbers, not .S4"),
        (
            {"betas": np.zeros((3, 10))},
            "'betas' must be one row of numbers or one for each frame, has 3 x 10",
        ),
        ({"scale": -1.0}, "'scale' must be one positive number"),
        ({"scale": np.ones(3)}, "'scale' must be one positive number, or one for each of 4 frames"),
        ({"mocap_framerate": 1e-310}, "1e-310 frames per second is not the rate of a motion"),
        (
            {"poses": np.zeros((90_910, 72), np.uint8)},
            "90910 frames of 55 joints are too many; at most 5,000,000 poses",
        ),
        (
            {"up_axis": np.frombuffer(b"\xff" * 4, "<U1")},
            "'up_axis' is not an array .*what is no text",
        ),
        ({"up_axis": ["y", "z"]}, "'up_axis' must be 'y' or 'z', not"),
        ({"up_axis": "x"}, "'up_axis' must be 'y' or 'z', not 'x'"),
        (
            {"poses": None, "root_orient": np.zeros((4, 3)), "pose_body": np.zeros((4, 60))},
            "'pose_body' must hold .*, has 4 x 60",
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


@pytest.mark.parametrize("content", [b"", b"PK\3\4", b"not an archive", b"\x93NUMPY\1\0"])
def test_files_of_another_kind(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.npz").write_bytes(content)
    with pytest.raises(DyngsError, match=r"x\.npz: ") as caught:
        read_amass(tmp_path / "x.npz", tiny_body())
    assert "\n" not in str(caught.value)


def test_a_single_array_and_a_missing_file(tmp_path: Path) -> None:
    np.save(tmp_path / "x.npy", np.zeros(3))
    for name in ("x.npy", "none.npz"):
        with pytest.raises(DyngsError, match=name):
            read_amass(tmp_path / name, tiny_body())


def test_the_turned_root_of_a_person_lying_on_the_back(tmp_path: Path) -> None:
    """In a z-up world, a standing SMPL body is turned by 90 degrees about x: that becomes no turn
    at all."""
    poses = np.zeros((FRAMES, 165))
    poses[:, 0] = np.pi / 2
    motion = read(tmp_path, numbers(poses=poses))
    assert motion.poses.abs().max() < 1e-6


# --- writing
# ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fps", [30.0, 29.97, 1 / 3])
def test_saved_motions_are_read_exactly(tmp_path: Path, fps: float) -> None:
    """On whatever body, and the same motion is the same file."""
    motion = replace(random_motion(), fps=fps, betas=torch.randn(7), scale=torch.rand(4) + 0.1)
    write_amass(motion, tmp_path / "new" / "x.npz")
    for body in (BODY, tiny_body(24)):
        found = read_amass(tmp_path / "new" / "x.npz", body)
        for name in ("poses", "trans", "betas", "scale"):
            assert torch.equal(getattr(found, name), getattr(motion, name)), name
        assert found.fps == fps
    write_amass(found, tmp_path / "y.npz")
    assert (tmp_path / "y.npz").read_bytes() == (tmp_path / "new" / "x.npz").read_bytes()


def test_saved_files_are_those_of_amass(tmp_path: Path) -> None:
    write_amass(random_motion(), tmp_path / "x.npz")
    with np.load(tmp_path / "x.npz", allow_pickle=False) as file:
        assert file["poses"].shape == (4, 165)
        assert {str(file[key]) for key in ("surface_model_type", "gender", "up_axis")} == {
            "smplx",
            "neutral",
            "y",
        }


def test_what_cannot_be_saved(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"x\.bvh: a motion is written as \.npz"):
        write_amass(random_motion(), tmp_path / "x.bvh")
    with pytest.raises(ValueError, match="must be"):
        write_amass(random_motion().for_joints(24), tmp_path / "x.npz")
    (tmp_path / "file").write_text("")
    with pytest.raises(DyngsError, match="cannot write"):
        write_amass(random_motion(), tmp_path / "file" / "x.npz")
