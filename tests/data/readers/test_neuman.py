"""NeuMan folders."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny_captures import write_colmap, write_image

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import merge_root_rotation
from dyngs.data.capture import BodyFrames, Capture, Silhouette
from dyngs.data.readers.neuman import FORMAT, read_neuman

COUNT = 9
NAMES = [f"{i:02d}.jpg" for i in range(COUNT)]
PELVIS = np.array([0.02, -0.24, 0.03])


def fit() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "pose": rng.normal(size=(COUNT, 72)).astype(np.float32),
        "betas": np.ones((COUNT, 10), np.float32),
    }


def alignment(index: int) -> tuple[float, Rotation, np.ndarray]:
    """Scale, rotation and translation from the body's frame to the world."""
    rng = np.random.default_rng(100 + index)
    return 0.5 + 0.1 * index, Rotation.from_rotvec(rng.normal(size=3)), rng.normal(size=3)


def matrices() -> dict[str, np.ndarray]:
    """Return the matrices of ``alignments.npy``, which multiply row vectors from the right."""
    found = {}
    for index, name in enumerate(NAMES):
        scale, turn, trans = alignment(index)
        found[name] = np.concatenate([scale * turn.as_matrix().T, trans[None]]).astype(np.float32)
    return found


def write_fit(root: Path, person: object, alignments: object) -> None:
    (root / "smpl_output_romp.pkl").write_bytes(pickle.dumps(person))
    np.save(root / "alignments.npy", np.array(alignments, dtype=object), allow_pickle=True)


def write_aligned(root: Path, **changes: Any) -> None:
    fields = {
        "global_orient": np.full((COUNT, 3), 0.1),
        "body_pose": np.full((COUNT, 69), 0.2),
        "betas": np.ones((COUNT, 10)),
        "transl": np.arange(COUNT)[:, None] * np.ones(3),
        "scale": np.full(COUNT, 0.7),
    } | changes
    (root / "4d_humans").mkdir(exist_ok=True)
    np.savez(root / "4d_humans/smpl_optimized_aligned_scale.npz", **fields)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Nine images of 12x8."""
    write_colmap(tmp_path, extension="txt")
    for name in NAMES:
        write_image(tmp_path / "segmentations" / name, np.zeros((8, 12, 1), np.uint8))
    write_fit(tmp_path, {1: fit()}, matrices())
    return tmp_path


def body_of(capture: Capture) -> BodyFrames:
    body: Any = capture.body
    assert body["train"] is body["val"] is body["test"]
    return body["train"]


def test_views(root: Path) -> None:
    assert FORMAT.recognise(root)
    capture = read_neuman(root)
    assert (capture.format, capture.warnings, set(capture.splits)) == ("neuman", (), {"train"})
    assert capture.points is not None
    views = capture.splits["train"]
    assert [(v.frame, v.time, v.camera_id) for v in views] == [(i, i / 8, 0) for i in range(COUNT)]
    assert views[3].silhouette == Silhouette(root / "segmentations/03.jpg", "black")


def test_bodies_are_brought_into_the_models_world(root: Path) -> None:
    """``world = s R v + t`` with v as SMPL has it without a translation; here a point that hangs on
    the root alone."""
    body = body_of(read_neuman(root))
    same = merge_root_rotation(body, PELVIS)
    point = np.array([0.3, 0.1, -0.2])
    for index in range(COUNT):
        scale, turn, trans = alignment(index)
        v = Rotation.from_rotvec(fit()["pose"][index, :3]).apply(point - PELVIS) + PELVIS
        root_turn = Rotation.from_rotvec(same.poses[index, 0])
        ours = same.scale[index] * (root_turn.apply(point - PELVIS) + PELVIS) + same.trans[index]
        # alignments are float32
        np.testing.assert_allclose(ours, scale * turn.apply(v) + trans, atol=1e-6)
    assert same.scale == pytest.approx([alignment(i)[0] for i in range(COUNT)], rel=1e-6)
    assert body.betas.tolist() == [1] * 10


def test_refined_parameters_come_first(root: Path) -> None:
    write_aligned(root)
    body = body_of(read_neuman(root))
    assert (body.origin_rotations, body.scale.tolist(), body.trans[:, 0].tolist()) == (
        None,
        [0.7] * COUNT,
        list(range(COUNT)),
    )
    assert body.poses[4].ravel() == pytest.approx([0.1] * 3 + [0.2] * 69)
    for name in ("alignments.npy", "smpl_output_romp.pkl"):
        (root / name).unlink()
    assert FORMAT.recognise(root)
    assert body_of(read_neuman(root)).kind == "smpl"


def test_optimized_before_romp(root: Path) -> None:
    (root / "smpl_output_optimized.pkl").write_bytes(
        pickle.dumps({1: {**fit(), "betas": np.zeros((COUNT, 10))}})
    )
    assert not body_of(read_neuman(root)).betas.any()


def test_splits(root: Path) -> None:
    (root / "train_split.txt").write_text("00.jpg\n02.jpg\n03.jpg\n")
    (root / "val_split.txt").write_text("04.jpg\n99.jpg\n")
    (root / "test_split.txt").write_text("01.jpg\n")
    capture = read_neuman(root)
    frames = {name: [view.frame for view in views] for name, views in capture.splits.items()}
    assert frames == {"train": [0, 2, 3], "val": [4], "test": [1]}
    assert capture.warnings == ("1 images of the splits have no pose and are skipped: 99.jpg",)
    (root / "train_split.txt").unlink()
    assert [view.frame for view in read_neuman(root).splits["train"]] == [0, 2, 3, 5, 6, 7, 8]
    (root / "test_split.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(DyngsError, match=r"test_split\.txt: cannot be read"):
        read_neuman(root)


def test_missing_masks_are_counted(root: Path) -> None:
    (root / "segmentations/02.jpg").unlink()
    assert read_neuman(root).warnings == ("1 images have no mask in segmentations, first 02.jpg",)


def test_missing_files(root: Path) -> None:
    (root / "alignments.npy").unlink()
    assert FORMAT.recognise(root)
    with pytest.raises(DyngsError, match=r"alignments\.npy: no such file"):
        read_neuman(root)
    write_fit(root, {1: fit()}, matrices())
    (root / "smpl_output_romp.pkl").unlink()
    assert FORMAT.recognise(root)
    with pytest.raises(DyngsError, match=r"smpl_output_optimized\.pkl: no such file"):
        read_neuman(root)
    (root / "alignments.npy").unlink()
    assert not FORMAT.recognise(root)


@pytest.mark.parametrize(
    ("person", "line"),
    [
        ({1: fit(), 2: fit()}, "cannot be read .* must hold the body parameters of one person"),
        ([fit()], "cannot be read"),
        ({1: {"pose": fit()["pose"]}}, "cannot be read .*betas"),
        (
            {1: {**fit(), "pose": np.zeros((4, 72))}},
            "'poses' must have one row of numbers for each of 9",
        ),
    ],
)
def test_bad_fits(root: Path, person: object, line: str) -> None:
    write_fit(root, person, matrices())
    with pytest.raises(DyngsError, match=line) as caught:
        read_neuman(root)
    assert "smpl_output_romp.pkl" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("matrix", "line"),
    [
        (None, "the key '04.jpg' is missing"),
        (np.zeros((4, 4)), r"04\.jpg must hold 4x3 finite numbers"),
        (np.zeros((4, 3)), r"04\.jpg: the alignment is not a similarity"),
        (-np.eye(4)[:, :3], r"04\.jpg: the alignment is not a similarity"),
        (np.eye(4)[:, :3] * [1, 2, 3], r"04\.jpg: the pose is not a rotation"),
    ],
)
def test_bad_alignments(root: Path, matrix: np.ndarray | None, line: str) -> None:
    found = {
        name: value for name, value in {**matrices(), "04.jpg": matrix}.items() if value is not None
    }
    write_fit(root, {1: fit()}, found)
    with pytest.raises(DyngsError, match=line) as caught:
        read_neuman(root)
    assert "alignments.npy" in str(caught.value)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            {"body_pose": np.zeros((COUNT - 1, 69))},
            "cannot be read",
        ),
        ({"body_pose": np.zeros((COUNT, 66))}, "'poses' has 69 numbers per frame"),
        ({"scale": np.zeros(COUNT)}, "'scale' must be positive"),
        ({"transl": np.zeros((COUNT, 2))}, "'trans' has 2 numbers per frame instead of 3"),
    ],
)
def test_bad_refined_parameters(root: Path, change: dict[str, Any], line: str) -> None:
    write_aligned(root, **change)
    with pytest.raises(DyngsError, match=line) as caught:
        read_neuman(root)
    assert "smpl_optimized_aligned_scale.npz" in str(caught.value)


def test_the_last_frames_are_held_out_as_new_poses(root: Path) -> None:
    (root / "test_split.txt").write_text("01.jpg\n07.jpg\n")
    capture = read_capture(DataConfig(root=root, pose_frames="6:9"))
    frames = {name: {view.frame for view in views} for name, views in capture.splits.items()}
    assert frames == {"train": {0, 2, 3, 4, 5}, "val": set(), "test": {1}, "pose": {6, 7, 8}}
