"""Reports on captures and videos: quiet about good ones, one line per planted fault."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from scipy.spatial.transform import Rotation
from stage_videos import camera, corner, write_videos
from tiny_captures import opengl_pose

from dyngs.capture.inspection import (
    body_problems,
    build_report,
    check_before_training,
    describe_masks,
    draw_cameras,
    format_report,
    inspect_capture,
    video_facts,
    video_report,
)
from dyngs.capture.sfm.several_videos import open_video
from dyngs.cli import main
from dyngs.config import DataConfig
from dyngs.data.body_frames import build_body_frames, share_body_across_splits
from dyngs.data.capture import Capture, PointCloud, View
from dyngs.data.geometry import from_opengl_pose, pinhole_matrix
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import StaticOptions, hemisphere_cameras, write_static_capture
from dyngs.export.video import video_writer
from dyngs.io.write import write_image


def clip(count: int, degrees: float) -> Capture:
    """One camera on its way around the origin, an image at each time."""
    k = pinhole_matrix(40.0, 40.0, 16.0, 12.0)
    poses = [from_opengl_pose(opengl_pose(np.radians(degrees) * i)) for i in range(count)]
    views = [
        View(f"{i:03d}", Path(f"{i}.png"), p, k, 32, 24, time=i / (count - 1))
        for i, p in enumerate(poses)
    ]
    return Capture(Path("clip"), "nerfstudio", {"train": tuple(views), "test": ()})


def with_points(capture: Capture, xyz: np.ndarray) -> Capture:
    return capture.replace(points=PointCloud(xyz, np.zeros(xyz.shape, np.uint8)))


@pytest.mark.parametrize(
    ("count", "degrees", "says"), [(12, 35.0, True), (12, 2.0, False), (100, 100.0, False)]
)
def test_few_images_far_apart_are_ill_posed(count: int, degrees: float, says: bool) -> None:
    """Not those of a video, nor many that jump about as in D-NeRF."""
    lines = check_before_training(clip(count, degrees))
    expected = (
        "12 images at different times, 31 degrees apart on average: "
        "moving objects are seen from one side"
    )
    assert [line.startswith(expected) for line in lines] == [True] * says


def test_one_fixed_camera() -> None:
    capture = clip(12, 0.0)
    (line,) = check_before_training(capture)
    assert "a single fixed camera recorded all 12 times" in line


def test_points_and_cameras_that_do_not_meet() -> None:
    capture = clip(40, 9.0)
    xyz = np.random.default_rng(0).normal(size=(300, 3)) * 0.3
    assert check_before_training(with_points(capture, xyz)) == []
    far = with_points(capture, np.concatenate([xyz, xyz[:150] + np.array([0, 0, 50.0])]))
    assert any(
        "33% of the points are not visible in any view" in line
        for line in check_before_training(far)
    )


@pytest.mark.parametrize(
    "name",
    [
        "lego400",
        "colmap_small",
        "fox",
        "orbits",
        "flag",
        "stage",
        "clip_duck",
        "human/casual_m",
        "human/busi_f",
    ],
)
def test_no_false_alarms(shared: Path, name: str) -> None:
    assert check_before_training(read_capture(shared / name)) == []


def capture_with(tmp_path: Path, mask: np.ndarray | None) -> Capture:
    """Return six images, all but the first with the same mask."""
    views = []
    for i in range(6):
        write_image(tmp_path / f"{i}.png", np.random.default_rng(i).uniform(size=(8, 12, 3)))
        view = View(
            f"{i}", tmp_path / f"{i}.png", opengl_pose(float(i)), np.diag([10.0, 10.0, 1.0]), 12, 8
        )
        if mask is not None and i:
            write_image(tmp_path / f"mask{i}.png", mask[..., None])
            view = replace(view, mask_path=tmp_path / f"mask{i}.png")
        views.append(view)
    return Capture(tmp_path, "nerfstudio", {"train": tuple(views), "test": ()})


def mask_of(kept: int, value: int = 255) -> np.ndarray:
    """Return a mask that keeps the first rows."""
    mask = np.zeros((8, 12), np.uint8)
    mask[:kept] = value
    return mask


@pytest.mark.parametrize("mask", [mask_of(1), mask_of(7, 1)])
def test_masks_that_ignore_nearly_everything(tmp_path: Path, mask: np.ndarray) -> None:
    capture = capture_with(tmp_path, mask)
    (problem,) = describe_masks(capture)[1]
    assert problem.startswith("masks ignore ")
    assert str(tmp_path / "mask1.png") in problem
    assert problem in check_before_training(capture)
    assert problem in build_report(capture).problems


@pytest.mark.parametrize(
    "sides", [(), (0,), (90,), (180,), (270,), (350, 10), (80, 100), (0, 170), (0, 120, 240)]
)
@pytest.mark.parametrize("turns", [None, 140.0])
def test_sides_of_a_person_that_no_camera_sees(
    tmp_path: Path, sides: tuple[float, ...], turns: float | None
) -> None:
    # One frame per camera; the person leans, is turned to the world, and the camera stands at an
    # angle to the body.
    view = clip(3, 1).splits["train"][0]
    poses = []
    trans = []
    views = []
    for row, side in enumerate(sides):
        heading = 77.0 * row
        turned = Rotation.from_euler("Y", heading, degrees=True) * Rotation.from_euler(
            "X", 8, degrees=True
        )
        place = np.array([5.0, 1.0, row])
        around = np.radians(side)
        centre = place + turned.apply([3 * np.sin(around), 0.4, 3 * np.cos(around)])
        pose = np.eye(4)
        pose[:3, 3] = -centre  # where it looks does not matter here
        views.append(replace(view, cam_from_world=pose, frame=row))
        given = (
            turned
            if turns is None
            else Rotation.from_rotvec([0, np.radians(turns), 0]).inv() * turned
        )
        poses.append(np.concatenate([given.as_rotvec(), np.zeros(69)]))
        trans.append(place)
    if not sides:
        assert body_problems(Capture(root=tmp_path, format="x", splits={"train": ()})) == []
        return
    whole = None if turns is None else np.tile([0, np.radians(turns), 0], (len(sides), 1))
    body = build_body_frames(
        tmp_path, range(len(sides)), poses, trans, np.zeros(10), origin_rotations=whole
    )
    capture = Capture(
        root=tmp_path,
        format="x",
        splits={"train": tuple(views)},
        body=share_body_across_splits(body),
    )
    found = body_problems(capture)
    unseen = {(0,): "back", (90,): "right side", (180,): "front", (270,): "left side"}
    unseen |= {(350, 10): "back", (80, 100): "right side"}
    assert [line.split(" is in no image")[0] for line in found] == [
        f"the person's {side}" for key, side in unseen.items() if key == sides
    ]
    assert set(found) <= set(check_before_training(capture))


def _capture(root: Path, count: int = 6) -> Capture:
    """A capture that is in order, its images on disk."""
    views = []
    for i, pose in enumerate(hemisphere_cameras(count, 4.0, 0)):
        path = root / f"{i}.png"
        write_image(path, np.zeros((24, 32, 3), np.uint8))
        k = np.array([[40.0, 0, 16], [0, 40.0, 12], [0, 0, 1]])
        views.append(View(f"{i}", path, from_opengl_pose(pose), k, 32, 24))
    rng = np.random.default_rng(0)
    points = PointCloud(
        rng.normal(size=(200, 3)) * 0.3, rng.integers(0, 256, (200, 3), dtype=np.uint8)
    )
    return Capture(root, "blender", {"train": tuple(views[1:]), "test": tuple(views[:1])}, points)


def _with_view(capture: Capture, **changes: Any) -> Capture:
    first, *others = capture.splits["train"]
    return capture.replace(splits={**capture.splits, "train": (replace(first, **changes), *others)})


def test_a_good_capture_is_quiet(tmp_path: Path) -> None:
    report = build_report(_capture(tmp_path), deep=True)
    assert not report.problems, report.problems
    text = format_report(report)
    for fact in ("5 train, 1 test", "32x24", "40 px", "43.6 degrees", "200", "no problems found"):
        assert fact in text, text


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"image_path": Path("nowhere.png")}, "nowhere.png"),
        ({"width": 33}, "has 32x24 pixels, but its camera is 33x24"),
        *(
            ({"intrinsics": np.array([[fx, 0, cx], [0, fy, 12], [0, 0, 1]])}, "unusual intrinsics")
            for fx, fy, cx in ((40.0, 40.0, 99), (40.0, 80.0, 16), (4e4, 4e4, 16))
        ),
    ],
)
def test_one_bad_view_gives_its_line(tmp_path: Path, changes: dict[str, Any], line: str) -> None:
    report = build_report(_with_view(_capture(tmp_path), **changes))
    assert any(line in problem for problem in report.problems), report.problems
    assert all("\n" not in problem for problem in report.problems)
    assert line in format_report(report)


def test_scene_faults(tmp_path: Path) -> None:
    good = _capture(tmp_path)
    assert build_report(good.replace(warnings=("something odd",))).problems == ("something odd",)
    untested = good.replace(splits={"train": good.splits["train"][:2], "test": ()})
    assert [line.split(",")[0] for line in build_report(untested).problems] == [
        "no test views",
        "only 2 training views; use at least 20",
    ]
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    turned = {
        split: tuple(replace(view, cam_from_world=flip @ view.cam_from_world) for view in views)
        for split, views in good.splits.items()
    }
    for points in (good.points, None):
        problems = build_report(good.replace(splits=turned, points=points)).problems
        assert any("look away" in line for line in problems), problems
    still = _with_view(good, cam_from_world=good.splits["test"][0].cam_from_world)
    assert any("have the same pose" in line for line in build_report(still).problems)


def _sequence(root: Path, cameras: int, times: int) -> Capture:
    """Cameras at rest that see all times, the first one for testing."""
    good = _capture(root, max(cameras, 2))
    views = [view for split in ("test", "train") for view in good.splits[split]][:cameras]  # type: ignore[index]
    seen = [
        [
            replace(
                view,
                name=f"c{i}/{time}",
                image_path=root / f"c{i}_{time}.png",
                time=time / (times - 1),
                camera_id=i,
            )
            for time in range(times)
        ]
        for i, view in enumerate(views)
    ]
    for view in (view for same in seen for view in same):
        write_image(view.image_path, np.zeros((24, 32, 3), np.uint8))
    test = seen[0] if cameras > 1 else seen[0][:1]
    train = [view for same in seen[1:] for view in same] if cameras > 1 else seen[0][1:]
    return good.replace(splits={"train": tuple(train), "test": tuple(test)})


def test_cameras_by_times(tmp_path: Path) -> None:
    report = build_report(_sequence(tmp_path, 4, 3))
    assert not report.problems, report.problems
    facts = dict(report.facts)
    assert facts["times"] == "3 in 0 to 1"
    assert facts["sequence"] == "4 cameras x 3 times, 12 images"


def test_drawing_shows_cameras_and_points(tmp_path: Path) -> None:
    capture = _capture(tmp_path)
    draw_cameras(capture, tmp_path / "cameras.png", size=100)
    pixels = np.asarray(oiio.ImageBuf(str(tmp_path / "cameras.png")).get_pixels(oiio.UINT8)).astype(
        int
    )
    assert pixels.shape == (100, 200, 3)
    for panel in (pixels[:, :100], pixels[:, 100:]):
        orange = (panel[..., 0] > 150) & (panel[..., 2] < 120) & (panel[..., 1] > 80)
        blue = (panel[..., 2] > 180) & (panel[..., 0] < 120)
        assert orange.any()
        assert blue.any()


def test_links_that_leave_the_capture_are_reported(tmp_path: Path) -> None:
    """Also those that no image needs; and an image that lies outside is the first problem."""
    root = tmp_path / "capture"
    write_static_capture(root, StaticOptions(size=8, num_train=4))
    assert not inspect_capture(root).problems
    (root / "notes").symlink_to(tmp_path)
    report = inspect_capture(root)
    assert report.capture is not None
    assert report.problems == (
        f"{root / 'notes'}: link to {tmp_path.resolve()}, outside the capture",
    )
    image = next((root / "train").iterdir())
    image.rename(tmp_path / "own.png")
    image.symlink_to(tmp_path / "own.png")
    report = inspect_capture(root)
    assert report.capture is None
    assert "outside the capture" in report.problems[0]
    assert any(f"{image}: link to " in line for line in report.problems[1:])
    followed = inspect_capture(DataConfig(root=root, follow_links=True))
    assert followed.capture is not None


def _turning(path: Path, blurred: int = -1) -> Path:
    with video_writer(path, fps=10) as add:
        for i in range(8):
            rgb = corner(camera(30.0 + 2 * i), 0.0)
            add(np.full_like(rgb, 128) if i == blurred else rgb)
    return path


def test_a_camera_that_moves(tmp_path: Path) -> None:
    path = _turning(tmp_path / "walk.mp4", blurred=5)
    facts, stands = video_facts(open_video(path))
    assert not stands
    assert facts["size"] == "240x180"
    assert facts["frames"] == "8 in 0.80 s, 10 per second"
    assert facts["sound"] == "none"
    assert "1 blurred frame" in facts["sharpness"]
    assert "moves" in facts["camera"]
    assert "colours" not in facts
    assert f"dyngs train static {path}" in video_report(path)


def test_cameras_that_stand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / "rig"
    write_videos(rig, {"a": 40.0, "b": 50.0}, {"a": 0.0, "b": 0.0}, 10.0, 8)
    assert "gives no depth" in video_report(rig / "a.mp4")
    assert main(["data", "inspect", str(rig)]) == 0
    shown = capsys.readouterr().out
    assert "2 fixed cameras; offsets between them: estimated from sound" in shown
    assert f"next: dyngs train dynamic {rig}" in shown
    _turning(rig / "walk.mp4")
    assert "next: remove walk" in video_report(rig)
