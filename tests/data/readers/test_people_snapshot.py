"""PeopleSnapshot folders."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tiny_captures import HEIGHT, WIDTH, pixel_of, write_video

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.images.maps import apply_silhouette
from dyngs.data.readers.people_snapshot import FORMAT, read_people_snapshot

h5py = pytest.importorskip("h5py", reason="needs dyngs[people]")

FRAMES = 6


def write_camera(root: Path, **changes: Any) -> None:
    fields = {
        "camera_t": np.array([0.1, 0.2, 0.3]),
        "camera_rt": np.array([0.0, 0.4, 0.0]),
        "camera_f": np.array([20.0, 21.0]),
        "camera_c": np.array([8.0, 6.0]),
        "camera_k": np.array([0.1, 0.0, 0.0, 0.0, 0.0]),
        "width": WIDTH,
        "height": HEIGHT,
    } | changes
    (root / "camera.pkl").write_bytes(
        pickle.dumps({k: v for k, v in fields.items() if v is not None}, 2)
    )


def write_hdf5(path: Path, **arrays: np.ndarray | None) -> None:
    with h5py.File(path, "w") as file:
        for name, value in arrays.items():
            if value is not None:
                file.create_dataset(name, data=value, compression="lzf")


def write_poses(root: Path, **changes: np.ndarray | None) -> None:
    """One row more than the video has frames, which was never fitted, as in the real files."""
    numbers = np.append(1.0 + np.arange(FRAMES), 0.0)[:, None]
    fields = {"pose": numbers * np.ones(72), "trans": numbers * np.ones(3), "betas": np.ones(10)}
    write_hdf5(root / "reconstructed_poses.hdf5", **(fields | changes))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A subject with 6 frames of 16x12, its mask one pixel that moves."""
    subject = tmp_path / "female-3-casual"
    write_video(subject / "female-3-casual.mp4", FRAMES)
    masks = np.zeros((FRAMES, HEIGHT, WIDTH), np.uint8)
    masks[range(FRAMES), 2, range(FRAMES)] = 1
    write_hdf5(subject / "masks.hdf5", masks=masks)
    write_camera(subject)
    write_poses(subject)
    return subject


def test_frames_masks_and_parameters_go_together(root: Path) -> None:
    assert FORMAT.recognise(root)
    capture = read_people_snapshot(root)
    assert (capture.format, capture.warnings, set(capture.splits)) == (
        "people_snapshot",
        (),
        {"train"},
    )
    views = capture.splits["train"]
    assert [(v.frame, v.time) for v in views] == [(f, f / 5) for f in range(FRAMES)]
    assert views[2].name == "female-3-casual/frame_000002"
    body: Any = capture.body
    assert body["train"].frames == tuple(range(FRAMES))
    assert body["train"].trans[:, 0].tolist() == [1, 2, 3, 4, 5, 6]
    assert (body["train"].kind, body["train"].origin_rotations, body["train"].betas.tolist()) == (
        "smpl",
        None,
        [1] * 10,
    )
    for frame, view in enumerate(views):
        assert view.silhouette is not None
        alpha = apply_silhouette(torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8), view.silhouette)[
            ..., 3
        ]
        assert alpha.nonzero().tolist() == [[2, frame]]


def test_camera(root: Path) -> None:
    view = read_people_snapshot(root).splits["train"][0]
    point = np.array([0.1, -0.2, 3.0])
    x, y, z = np.add(Rotation.from_rotvec([0, 0.4, 0]).apply(point), (0.1, 0.2, 0.3))
    assert pixel_of(view, point.tolist()) == pytest.approx([20 * x / z + 8, 21 * y / z + 6])
    assert (view.lens.model, view.lens.params[0], view.width, view.height) == (
        "opencv",
        0.1,
        WIDTH,
        HEIGHT,
    )


def test_frames_without_mask_or_fit_are_left_out(root: Path) -> None:
    write_hdf5(root / "masks.hdf5", masks=np.ones((4, HEIGHT, WIDTH), np.uint8))
    numbers = np.array([1.0, 0, 3, 4])[:, None]
    write_poses(root, pose=numbers * np.ones(72), trans=numbers * np.ones(3))
    capture = read_people_snapshot(root)
    assert [view.frame for view in capture.splits["train"]] == [0, 2, 3]
    assert capture.warnings == (
        "female-3-casual.mp4: 3 of 6 frames have no mask or no pose and are skipped",
    )


def test_smaller_video(root: Path) -> None:
    write_camera(root, width=2 * WIDTH, height=2 * HEIGHT)
    capture = read_people_snapshot(root)
    assert capture.splits["train"][0].intrinsics[0, 0] == 10
    assert "differ in size from their intrinsics" in capture.warnings[0]


def test_videos(root: Path) -> None:
    write_video(root / "other.mp4", 2)
    assert len(read_people_snapshot(root).splits["train"]) == FRAMES
    (root / "female-3-casual.mp4").rename(root / "another.mp4")
    with pytest.raises(DyngsError, match=r"found 2 videos; keep one, named female-3-casual\.mp4"):
        read_people_snapshot(root)
    (root / "another.mp4").unlink()
    (root / "other.mp4").unlink()
    with pytest.raises(DyngsError, match="found no video"):
        read_people_snapshot(root)


def test_missing_files(root: Path) -> None:
    for name in ("masks.hdf5", "reconstructed_poses.hdf5"):
        content = (root / name).read_bytes()
        (root / name).unlink()
        assert FORMAT.recognise(root)
        with pytest.raises(DyngsError, match=f"{name}: no such file"):
            read_people_snapshot(root)
        (root / name).write_bytes(content)
    (root / "camera.pkl").unlink()
    assert not FORMAT.recognise(root)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"pose": None}, "'pose' must be a data set"),
        ({"pose": np.ones((3, 72))}, "'pose' has 3 rows but 'trans' 7"),
        ({"pose": np.zeros((7, 72)), "trans": np.zeros((7, 3))}, "no frames found"),
    ],
)
def test_bad_parameters(root: Path, change: dict[str, Any], line: str) -> None:
    write_poses(root, **change)
    with pytest.raises(DyngsError, match=line) as caught:
        read_people_snapshot(root)
    assert "reconstructed_poses.hdf5" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"camera_f": None}, "the key 'camera_f' is missing"),
        ({"camera_f": np.array([0.0, 1.0])}, "fl_x must be positive"),
        ({"camera_k": np.zeros(4)}, "'camera_k' must hold 5 finite numbers"),
        ({"camera_t": np.array([0, np.nan, 0])}, "'camera_t' must hold 3 finite numbers"),
        ({"width": "wide"}, "'width' must hold 1 finite numbers"),
        ({"width": 3 * WIDTH}, "but its intrinsics are for 48x12"),
    ],
)
def test_bad_camera(root: Path, change: dict[str, Any], line: str) -> None:
    write_camera(root, **change)
    with pytest.raises(DyngsError, match=line) as caught:
        read_people_snapshot(root)
    assert "camera.pkl" in str(caught.value)


def test_no_frame_has_everything(root: Path) -> None:
    write_hdf5(root / "masks.hdf5", masks=np.ones((1, HEIGHT, WIDTH), np.uint8))
    poses = np.zeros((7, 72))
    poses[3:] = 1
    write_poses(root, pose=poses, trans=poses[:, :3])
    with pytest.raises(
        DyngsError, match=r"no frame of female-3-casual\.mp4 has both a mask and body parameters"
    ):
        read_people_snapshot(root)


def test_the_last_frames_are_held_out_as_new_poses(root: Path) -> None:
    capture = read_capture(DataConfig(root=root, pose_frames="4::", test_every=2))
    assert [
        [view.frame for view in capture.splits[name]] for name in ("train", "test", "pose")
    ] == [
        [0, 2, 3],
        [1],
        [4, 5],
    ]
    assert [view.time for view in capture.splits["pose"]] == [0, 1]
    assert capture.body is not None
    assert capture.body["pose"].frames == capture.body["train"].frames
