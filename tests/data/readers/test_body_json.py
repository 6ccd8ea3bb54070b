"""Blender captures of a person, with body parameters per frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_captures import edit_json, pixel_of, random_pixels, write_frames, write_image

from dyngs.config import DataConfig
from dyngs.data.body_frames import about_pelvis, rows_of
from dyngs.data.capture import BodyFrames, Capture, View
from dyngs.data.images.images import read_image
from dyngs.data.read import read_capture
from dyngs.data.readers.body_json import is_body_json, read_body_json
from dyngs.errors import DyngsError

LENS = {"w": 4, "h": 3, "fl_x": 5.0, "fl_y": 5.0, "cx": 2.0, "cy": 1.5}


def write_body(path: Path, count: int, first: float = 0.0, **changes: Any) -> None:
    """Parameters whose numbers tell their frame."""
    numbers = first + np.arange(count, dtype=np.float32)[:, None]
    fields = {"poses": numbers * np.ones(165), "trans": numbers * np.ones(3), "betas": np.zeros(10), "scale": 1.5}
    fields |= {"gender": "neutral", "mocap_frame_rate": 12.0, "surface_model_type": "smplx"}
    np.savez(path, **{name: value for name, value in (fields | changes).items() if value is not None})


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """3 frames by 2 cameras to train on and 1 to test, and 2 frames of another clip."""
    for split, count, cameras in (("train", 3, (0, 1)), ("test", 3, (2,)), ("pose", 2, (2,))):
        names = [f"images/{split}/f{frame}_c{camera}.png" for frame in range(count) for camera in cameras]
        path = tmp_path / f"transforms_{split}.json"
        write_frames(path, names, LENS)
        edit_json(path, lambda c, n=count, k=cameras: number_frames(c, n, k))
        for i, name in enumerate(names):
            write_image(tmp_path / name, random_pixels(3, 4, 4, seed=i))
    write_body(tmp_path / "body_train.npz", 3)
    write_body(tmp_path / "body_pose.npz", 2, first=10)
    return tmp_path


def number_frames(content: dict[str, Any], count: int, cameras: tuple[int, ...]) -> None:
    keys = [(frame, camera) for frame in range(count) for camera in cameras]
    for own, (frame, camera) in zip(content["frames"], keys, strict=True):
        own.update(frame=frame, camera=camera, time=frame / (count - 1))


def bodies(capture: Capture) -> dict[str, BodyFrames]:
    body: Any = capture.body
    return body


def test_every_split_has_its_frames(root: Path) -> None:
    assert is_body_json(root)
    capture = read_body_json(root)
    assert (capture.format, capture.warnings) == ("body_json", ())
    found = {
        str(split): [(view.frame, view.camera_id, view.time) for view in views]
        for split, views in capture.splits.items()
    }
    assert found == {
        "train": [(f, c, f / 2) for f in range(3) for c in (0, 1)],
        "test": [(f, 2, f / 2) for f in range(3)],
        "pose": [(0, 2, 0.0), (1, 2, 1.0)],
    }
    body = bodies(capture)
    assert body["test"] is body["train"] is body["val"]
    assert [(b.kind, len(b.frames), b.scale[0], b.trans[0, 0]) for b in (body["train"], body["pose"])] == [
        ("smplx", 3, 1.5, 0.0),
        ("smplx", 2, 1.5, 10.0),
    ]


def test_a_split_may_have_its_own_parameters(root: Path) -> None:
    write_body(root / "body_test.npz", 3, first=5)
    assert bodies(read_body_json(root))["test"].trans[:, 0].tolist() == [5, 6, 7]


def test_other_splits_may_lack(root: Path) -> None:
    for name in ("transforms_test.json", "transforms_pose.json", "body_pose.npz"):
        (root / name).unlink()
    write_body(root / "body_train.npz", 5, scale=None)
    capture = read_body_json(root)
    assert (set(capture.splits), set(bodies(capture))) == ({"train"}, {"train", "val", "test"})
    assert bodies(capture)["train"].scale.tolist() == [1] * 5


def test_missing_files(root: Path) -> None:
    (root / "body_pose.npz").unlink()
    with pytest.raises(DyngsError, match=r"body_pose\.npz: no such file; transforms_pose\.json shows another clip"):
        read_body_json(root)
    write_body(root / "body_pose.npz", 2)
    (root / "body_train.npz").unlink()
    assert is_body_json(root)
    with pytest.raises(DyngsError, match=r"body_train\.npz: no such file; it should hold the body parameters poses"):
        read_body_json(root)
    (root / "body_pose.npz").unlink()
    assert not is_body_json(root)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"poses": np.zeros((3, 63))}, r"body_train\.npz: 'poses' has 63 numbers per frame"),
        ({"trans": np.zeros((2, 3))}, r"body_train\.npz: 'trans' has 2 rows for 3 frames"),
        ({"trans": np.full((3, 3), np.nan)}, r"body_train\.npz: 'trans' of frame 0 holds NaN"),
        ({"scale": -1.0}, r"body_train\.npz: 'scale' must be positive"),
        ({"betas": None}, r"body_train\.npz: the key 'betas' is missing"),
        ({"poses": np.zeros(()), "trans": np.zeros(())}, r"body_train\.npz: holds no frame"),
        ({"poses": np.zeros((2, 165)), "trans": np.zeros((2, 3))}, r"no body parameters for 1 frames .*\(2\)"),
    ],
)
def test_bad_parameters(root: Path, change: dict[str, Any], line: str) -> None:
    write_body(root / "body_train.npz", 3, **change)
    with pytest.raises(DyngsError, match=line) as caught:
        read_body_json(root)
    assert "\n" not in str(caught.value)


def test_images_need_frame_numbers(root: Path) -> None:
    edit_json(root / "transforms_test.json", lambda content: content["frames"][1].pop("frame"))
    with pytest.raises(DyngsError, match=r"body_train\.npz: .*f1_c2\.png has no frame number"):
        read_body_json(root)


@pytest.mark.parametrize("name", ["casual_m", "busi_f"])
def test_the_pelvis_lies_inside_the_person(shared: Path, name: str) -> None:
    """Cameras, frames and parameters of every split agree: the template's pelvis appears on opaque pixels."""
    template = shared / "body" / "anny_smplx55_tpose.npz"
    if not (shared / "human" / name).is_dir() or not template.is_file():
        pytest.skip("the captures of people are not here")
    capture = read_body_json(shared / "human" / name)
    assert {str(split): len(views) for split, views in capture.splits.items()} == {"train": 160, "test": 80, "pose": 32}
    pelvis = np.load(template)["J"][0].astype(float)
    for split, body in bodies(capture).items():
        views: tuple[View, ...] = dict(capture.splits).get(split, ())[::11]  # type: ignore[call-overload]
        places = about_pelvis(body, pelvis)
        for view, row in zip(views, rows_of(capture.root, body, views), strict=True):
            x, y = pixel_of(view, places.scale[row] * pelvis + places.trans[row])
            assert read_image(view.image_path)[int(y), int(x), 3] == 255, view.name


def test_frames_are_held_out_where_no_other_clip_was_filmed(root: Path) -> None:
    with pytest.raises(DyngsError, match=r"has a clip of new poses of its own; remove data\.pose_frames=2::"):
        read_capture(DataConfig(root=root, pose_frames="2::"))
    for name in ("transforms_pose.json", "body_pose.npz"):
        (root / name).unlink()
    capture = read_capture(DataConfig(root=root, pose_frames="2::"))
    assert [view.name for view in capture.splits["pose"]] == ["images/test/f2_c2"]
    (root / "body_train.npz").unlink()
    with pytest.raises(DyngsError, match="is for people; here are no body parameters"):
        read_capture(DataConfig(root=root, pose_frames="2::"))


def test_times_that_are_not_given_follow_from_frame_numbers(root: Path) -> None:
    """Or else every image would be compared with the first pose."""
    timed = read_capture(DataConfig(root=root))
    for split in ("train", "test", "pose"):
        edit_json(root / f"transforms_{split}.json", lambda content: [own.pop("time") for own in content["frames"]])
    found = read_capture(DataConfig(root=root))
    for split, views in timed.splits.items():
        assert [view.time for view in found.splits[split]] == [view.time for view in views]
    assert {view.time for view in found.splits["train"]} == {0, 0.5, 1}
