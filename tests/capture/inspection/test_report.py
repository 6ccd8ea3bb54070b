"""The capture report: quiet about good captures, one line per planted fault."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from dyngs.capture.inspection.report import draw_cameras, format_report, inspect_capture, report_on
from dyngs.config import DataConfig
from dyngs.data.capture import Capture, PointCloud, View
from dyngs.data.geometry import cam_from_opengl
from dyngs.data.synthetic.captures import StillOptions, hemisphere_cameras, write_still_capture
from dyngs.io.write import write_image


def _capture(root: Path, count: int = 6) -> Capture:
    """A capture that is in order, its images on disk."""
    views = []
    for i, pose in enumerate(hemisphere_cameras(count, 4.0, 0)):
        path = root / f"{i}.png"
        write_image(path, np.zeros((24, 32, 3), np.uint8))
        k = np.array([[40.0, 0, 16], [0, 40.0, 12], [0, 0, 1]])
        views.append(View(f"{i}", path, cam_from_opengl(pose), k, 32, 24))
    rng = np.random.default_rng(0)
    points = PointCloud(
        rng.normal(size=(200, 3)) * 0.3, rng.integers(0, 256, (200, 3), dtype=np.uint8)
    )
    return Capture(root, "blender", {"train": tuple(views[1:]), "test": tuple(views[:1])}, points)


def _with_view(capture: Capture, **changes: Any) -> Capture:
    first, *others = capture.splits["train"]
    return capture.replace(splits={**capture.splits, "train": (replace(first, **changes), *others)})


def test_a_good_capture_is_quiet(tmp_path: Path) -> None:
    report = report_on(_capture(tmp_path), deep=True)
    assert not report.problems, report.problems
    text = format_report(report)
    for fact in ("5 train, 1 test", "32x24", "40 px", "43.6 degrees", "200", "nothing suspicious"):
        assert fact in text, text


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"image_path": Path("nowhere.png")}, "nowhere.png"),
        ({"width": 33}, "has 32x24 pixels, its camera says 33x24"),
        (
            {"intrinsics": np.array([[40.0, 0, 99], [0, 40, 12], [0, 0, 1]])},
            "far from the middle of 32x24",
        ),
        (
            {"intrinsics": np.array([[40.0, 0, 16], [0, 80, 12], [0, 0, 1]])},
            "differ by more than 10%",
        ),
        ({"intrinsics": np.array([[4e4, 0, 16], [0, 4e4, 12], [0, 0, 1]])}, "does not suit"),
    ],
)
def test_one_bad_view_gives_its_line(tmp_path: Path, changes: dict[str, Any], line: str) -> None:
    report = report_on(_with_view(_capture(tmp_path), **changes))
    assert any(line in problem for problem in report.problems), report.problems
    assert all("\n" not in problem for problem in report.problems)
    assert line in format_report(report)


def test_scene_faults(tmp_path: Path) -> None:
    good = _capture(tmp_path)
    assert report_on(good.replace(warnings=("something odd",))).problems == ("something odd",)
    untested = good.replace(splits={"train": good.splits["train"][:2], "test": ()})
    assert [line.split(",")[0] for line in report_on(untested).problems] == [
        "the split 'test' is empty",
        "only 2 training views; a scene needs some 20 or more",
    ]
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    turned = {
        split: tuple(replace(view, cam_from_world=flip @ view.cam_from_world) for view in views)
        for split, views in good.splits.items()
    }
    for points in (good.points, None):
        problems = report_on(good.replace(splits=turned, points=points)).problems
        assert any("look away" in line for line in problems), problems
    assert good.points is not None
    xyz = good.points.xyz.copy()
    xyz[0] = 1e5
    problems = report_on(good.replace(points=PointCloud(xyz, good.points.rgb))).problems
    assert any("1 of 200 points lie more than 50 times" in line for line in problems)
    still = _with_view(good, cam_from_world=good.splits["test"][0].cam_from_world)
    assert any("share their pose" in line for line in report_on(still).problems)


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
    report = report_on(_sequence(tmp_path, 4, 3))
    assert not report.problems, report.problems
    facts = dict(report.facts)
    assert facts["times"] == "3 in 0 to 1"
    assert facts["sequence"] == "4 cameras x 3 times, 12 images"
    assert "frame rate" not in facts
    moving = _with_view(_sequence(tmp_path, 4, 3), cam_from_world=np.eye(4))
    assert dict(report_on(moving).facts)["sequence"].startswith("4 cameras (1 moving) x 3 times")


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
    write_still_capture(root, StillOptions(size=8, num_train=4))
    assert not inspect_capture(root).problems
    (root / "notes").symlink_to(tmp_path)
    report = inspect_capture(root)
    assert report.capture is not None
    assert report.problems == (
        f"{root / 'notes'}: a link that leads out of the capture, to {tmp_path.resolve()}",
    )
    image = next((root / "train").iterdir())
    image.rename(tmp_path / "own.png")
    image.symlink_to(tmp_path / "own.png")
    report = inspect_capture(root)
    assert report.capture is None
    assert "lies outside the capture" in report.problems[0]
    assert any(f"{image}: a link that leads out" in line for line in report.problems[1:])
    followed = inspect_capture(DataConfig(root=root, follow_links=True))
    assert followed.capture is not None
