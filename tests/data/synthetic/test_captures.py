"""Synthetic captures and their true tracks."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import OpenImageIO as oiio
import pytest

from dyngs.api.load import read_capture
from dyngs.capture.inspection.report import inspect_capture
from dyngs.cli import main
from dyngs.cli.data import SYNTHETIC_SCENES
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture
from dyngs.data.geometry import camera_center
from dyngs.data.people_set import PEOPLE_FILE
from dyngs.data.synthetic import raytrace
from dyngs.data.synthetic.captures import (
    POINTS_PER_THING,
    DynamicOptions,
    StillOptions,
    hemisphere_cameras,
    is_in_image,
    orbit_cameras,
    render_scene,
    true_tracks,
    write_dynamic_capture,
    write_still_capture,
)
from dyngs.data.synthetic.raytrace import CAMERA_ANGLE_X, render_things
from dyngs.data.synthetic.scenes import SceneName, scene_at
from dyngs.io.write import write_image

NAMES: tuple[SceneName, ...] = get_args(SceneName)
SHORT = {"human": ("--cameras", "1"), "people": ("--people", "1", "--cameras", "2")}
TINY = DynamicOptions(size=16, num_times=5, num_test=3, num_val=2, num_cameras=3, samples=1)


def _files(root: Path) -> dict[str, bytes]:
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*") if p.is_file()}


def _read(root: Path) -> Capture:
    return read_capture(DataConfig(root=root))  # type: ignore[call-arg]


def _pixels(path: Path) -> np.ndarray:
    return oiio.ImageBuf(str(path)).get_pixels(oiio.UINT8)


def test_capture_has_blender_layout_and_repeats_bytewise(tmp_path: Path) -> None:
    options = StillOptions(size=24, num_train=3, num_val=1, num_test=2, samples=2)
    first, second = (write_still_capture(tmp_path / name, options) for name in ("a", "b"))
    assert _files(first) == _files(second)
    assert len(_files(first)) == 3 + 1 + 2 + 3
    for split, count in (("train", 3), ("val", 1), ("test", 2)):
        document = json.loads((first / f"transforms_{split}.json").read_text())
        assert document["camera_angle_x"] == CAMERA_ANGLE_X
        assert len(document["frames"]) == count
        for frame in document["frames"]:
            assert set(frame) == {"file_path", "transform_matrix"}
            pose = np.array(frame["transform_matrix"])
            np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
            np.testing.assert_allclose(
                pose[:3, 3], 4.0 * pose[:3, 2], atol=1e-12
            )  # OpenGL: z points away from the scene
            spec = oiio.ImageBuf(str(first / (frame["file_path"] + ".png"))).spec()
            assert (spec.width, spec.height, spec.nchannels) == (24, 24, 4)


def test_cameras_differ_by_seed_only_in_azimuth() -> None:
    a = hemisphere_cameras(7, 4.0, 0)
    b = hemisphere_cameras(7, 4.0, 1)
    assert not np.allclose(a, b)
    np.testing.assert_allclose(a[:, 2, 3], b[:, 2, 3])
    assert (a[:, 2, 3] > 0).all()


# ------------------------------------------------------------------------------------------------
# scenes that move


@pytest.mark.parametrize("name", ["spin", "room"])  # a camera per time, and fixed ones
def test_one_seed_gives_the_same_bytes_and_another_one_other_cameras(
    name: SceneName, tmp_path: Path
) -> None:
    first, second = (write_dynamic_capture(name, tmp_path / part, TINY) for part in ("a", "b"))
    assert _files(first) == _files(second)
    other = write_dynamic_capture(name, tmp_path / "c", replace(TINY, seed=1))
    assert _files(other).keys() == _files(first).keys()
    assert _files(other)["transforms_train.json"] != _files(first)["transforms_train.json"]


@pytest.mark.parametrize("name", [name for name in NAMES if name != "room"])
def test_one_camera_per_time_is_read_back_as_it_was_written(
    name: SceneName, tmp_path: Path
) -> None:
    capture = _read(write_dynamic_capture(name, tmp_path / "out", TINY))
    assert capture.has_alpha
    assert capture.warnings == ()
    times = {split: [view.time or 0.0 for view in views] for split, views in capture.splits.items()}
    assert times["train"] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert times["val"] == [0.0, 1.0]
    assert set(times["test"]) <= {0.125, 0.375, 0.625, 0.875}, "midway between training times"
    assert times["test"] == sorted(set(times["test"]))
    centers = {
        s: np.array([camera_center(v.cam_from_world) for v in views])
        for s, views in capture.splits.items()
    }
    for kept in centers.values():
        np.testing.assert_allclose(np.linalg.norm(kept, axis=1), 4.0)
    np.testing.assert_array_equal(centers["val"][0], centers["val"][1])
    heights = centers["train"][:, 2]
    assert not (np.diff(heights) > 0).all(), "the height of the camera must not tell the time"
    assert len(np.unique(heights.round(6))) == 5


def test_the_room_is_filmed_by_fixed_cameras_of_which_one_is_for_testing(tmp_path: Path) -> None:
    capture = _read(write_dynamic_capture("room", tmp_path / "out", TINY))
    assert not capture.has_alpha
    assert capture.warnings == ()
    seen = {
        split: {(v.camera_id, v.time) for v in views} for split, views in capture.splits.items()
    }
    assert seen["train"] == {(camera, i / 4) for camera in range(3) for i in range(5)}
    assert seen["test"] == {(3, i / 4) for i in range(5)}
    assert seen["val"] == {(4, i / 4) for i in range(5)}
    poses: dict[int, set[bytes]] = {}
    for views in capture.splits.values():
        for view in views:
            poses.setdefault(view.camera_id, set()).add(view.cam_from_world.tobytes())
    assert [len(poses[camera]) for camera in range(5)] == [1] * 5, "fixed"
    assert len(set.union(*poses.values())) == 5, "each somewhere else"
    azimuths = {}
    for camera, kept in poses.items():
        x, y, _ = camera_center(np.frombuffer(next(iter(kept))).reshape(4, 4))
        azimuths[camera] = np.degrees(np.arctan2(y, x))
    assert azimuths[0] < azimuths[3] < azimuths[2], (
        "the test camera stands between training cameras"
    )
    assert min(abs(azimuths[3] - azimuths[camera]) for camera in range(3)) > 5


@pytest.mark.parametrize("name", NAMES)
def test_each_image_shows_its_scene_at_its_time(name: SceneName, tmp_path: Path) -> None:
    root = write_dynamic_capture(name, tmp_path / "out", TINY)
    for split in ("train", "val", "test"):
        frame = json.loads((root / f"transforms_{split}.json").read_text())["frames"][-1]
        expected = render_scene(
            scene_at(name, frame["time"]), np.array(frame["transform_matrix"]), 16, 1
        )
        found = _pixels(root / (frame["file_path"] + ".png"))
        np.testing.assert_array_equal(found, expected[..., : found.shape[2]])
        assert found.shape[2] == (3 if name == "room" else 4)


@pytest.mark.parametrize("name", NAMES)
def test_held_out_images_have_masks_of_what_moves(name: SceneName, tmp_path: Path) -> None:
    root = write_dynamic_capture(name, tmp_path / "out", TINY)
    for split in ("train", "val", "test"):
        frames = json.loads((root / f"transforms_{split}.json").read_text())["frames"]
        assert all(("instance_mask_path" in frame) == (split != "train") for frame in frames)
        for frame in frames:
            things = _pixels(root / "things" / (frame["file_path"] + ".png"))
            expected = render_things(
                scene_at(name, frame["time"]), np.array(frame["transform_matrix"]), 16, 1
            )
            np.testing.assert_array_equal(things[..., 0], expected)
            assert (expected > 0).mean() < 0.6
            assert expected.any()


@pytest.mark.parametrize("name", NAMES)
def test_inspection_finds_nothing_suspicious(name: SceneName, tmp_path: Path) -> None:
    """But that so few images, each of a time of its own, show what moves from one side only; the
    room has cameras."""
    problems = inspect_capture(
        write_dynamic_capture(name, tmp_path / "out", TINY), deep=True
    ).problems
    assert len(problems) == (name != "room")
    assert all(line.endswith("expect a static result") for line in problems)


def test_one_time_and_many_test_images_are_allowed(tmp_path: Path) -> None:
    options = DynamicOptions(size=4, num_times=1, num_test=4, samples=1)
    capture = _read(write_dynamic_capture("spin", tmp_path / "out", options))
    assert [view.time for view in capture.splits["train"]] == [0.0]
    # 0.5 in the files: the end of the clip
    assert [view.time for view in capture.splits["test"]] == [1.0] * 4


def test_what_cannot_be_written_is_refused_before_anything_is(tmp_path: Path) -> None:
    used = tmp_path / "used"
    used.mkdir()
    (used / "mine.txt").write_text("keep")
    with pytest.raises(DyngsError, match="used exists already"):
        write_dynamic_capture("spin", used, TINY)
    with pytest.raises(DyngsError, match="nosuch"):
        write_dynamic_capture("nosuch", tmp_path / "new", TINY)  # type: ignore[arg-type]
    with pytest.raises(DyngsError, match="num_times"):
        write_dynamic_capture("room", tmp_path / "new", DynamicOptions(num_times=0))
    assert [p.name for p in tmp_path.rglob("*")] == ["used", "mine.txt"]


# ------------------------------------------------------------------------------------------------
# dyngs data synth


# one of each writer
@pytest.mark.parametrize("scene", ["still", "polyhedra", "spin", "human", "people"])
def test_an_interrupted_command_leaves_nothing_and_may_be_repeated(
    scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of people, those that are finished stay, to be added to."""
    words = [
        "data",
        "synth",
        scene,
        str(tmp_path / "out"),
        "--size",
        "8",
        "--views",
        "2",
        *SHORT.get(scene, ()),
    ]
    calls: list[Path] = []

    def interrupted(path: Path, pixels: np.ndarray) -> None:
        calls.append(path)
        if len(calls) == 2:
            raise KeyboardInterrupt
        write_image(path, pixels)

    for module in ("dyngs.data.synthetic.captures", "dyngs.human.synthetic.capture"):
        monkeypatch.setattr(f"{module}.write_image", interrupted)
    assert main(words) == 130
    left = sorted(path.name for path in tmp_path.rglob("*"))
    assert left == (["out", PEOPLE_FILE, "s0000"] if scene == "people" else [])
    monkeypatch.undo()
    assert main(words) == 0
    assert "written: " in capsys.readouterr().out


def test_the_command_knows_all_scenes() -> None:
    assert ("still", "polyhedra", *get_args(SceneName), "human", "people") == SYNTHETIC_SCENES


@pytest.mark.parametrize(
    ("words", "images", "preset"),
    [
        (["polyhedra", "--views", "3"], 3, "bg_triangle"),
        (["spin", "--views", "3"], 3, "dynamic"),
        (["room", "--views", "2", "--cameras", "3"], 6, "dynamic"),
        (["room", "--views", "2", "--style", "moving"], 2, "dynamic"),
    ],
)
def test_command_writes_and_says_what_is_next(
    words: list[str], images: int, preset: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, *options = words
    assert main(["data", "synth", name, str(tmp_path / "new"), "--size", "8", *options]) == 0
    assert (
        f"dyngs train configs/{preset}.yaml data.root={tmp_path / 'new'}" in capsys.readouterr().out
    )
    capture = _read(tmp_path / "new")
    assert len(capture.splits["train"]) == images
    assert {(view.width, view.height) for view in capture.splits["train"]} == {(8, 8)}


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("nosuch new", "'nosuch'"),
        ("spin used", "exists already"),
        ("spin new --views 0", "--views"),
        ("spin new --seed -1", "--seed"),
        ("still new --cameras 3", "--cameras"),
        ("spin new --style moving --cameras 3", "--cameras"),
        ("still new --style moving", "--style"),
        ("human new --style fixed", "--style"),
        ("room new --cameras 0", "--cameras"),
        ("room new --style teleport", "--style"),
    ],
)
def test_command_refuses_in_one_line(
    words: str,
    part: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("used").mkdir()
    Path("used/mine.txt").write_text("keep")
    assert main(["data", "synth", *words.split()]) != 0
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert part in lines[0]
    assert not Path("new").exists()


SIZE = 64
CAMERAS = ((16.0, -70.0), (34.0, -45.0), (22.0, -20.0), (45.0, -60.0), (28.0, -30.0))
"""Elevation and azimuth in degrees: the walls of the room stand behind what they show."""
NAMES: tuple[SceneName, ...] = get_args(SceneName)


def projected(points: np.ndarray, pose: np.ndarray, size: int = SIZE) -> np.ndarray:
    """(P, 2) pixels of an image of ``size``."""
    x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
    focal = 0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X)
    return np.stack([focal * x / -z, focal * y / z], axis=1) + 0.5 * size


@pytest.mark.parametrize("name", NAMES)
def test_visible_points_lie_where_something_moving_is_seen(name: SceneName) -> None:
    poses = [orbit_cameras(1, 4.0, elevation, azimuth)[0] for elevation, azimuth in CAMERAS]
    times = np.linspace(0, 1, 5)
    shots = [
        (f"v{i}", float(time), pose)
        for i, (time, pose) in enumerate(zip(times, poses, strict=True))
    ]
    tracks = true_tracks(lambda time: scene_at(name, time), shots)
    things = len(scene_at(name, 1.0).movers)
    assert tracks.points.shape == (5, POINTS_PER_THING * things, 3)
    assert tracks.views.tolist() == ["v0", "v1", "v2", "v3", "v4"]
    np.testing.assert_array_equal(tracks.times, times)
    np.testing.assert_array_equal(tracks.moments, range(5))
    for k, (_, time, pose) in enumerate(shots):
        seen = tracks.visible[k]
        assert seen.mean() > 0.1
        assert seen.mean() < 0.9 or name == "wave", (
            "others are on the far side or hidden, but not of a cloth"
        )
        labels = np.pad(render_things(scene_at(name, time), pose, SIZE), 1)
        x, y = projected(tracks.points[k][seen], pose).astype(int).T
        own = 1 + np.flatnonzero(seen) // POINTS_PER_THING
        near = np.any([labels[y + dy, x + dx] == own for dy in range(3) for dx in range(3)], axis=0)
        assert near.all(), "where its own thing is or, at an outline, next to it"


@pytest.mark.parametrize("name", ["roll"])
def test_a_track_keeps_the_colour_that_its_point_has_at_the_start(
    name: SceneName, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In grey light and without highlights, a pixel is a grey times the paint that its point had at
    time 0."""
    for light in ("_SKY", "_GROUND", "_LAMPLIGHT"):
        monkeypatch.setattr(raytrace, light, (0.4, 0.4, 0.4))
    pose = orbit_cameras(1, 4.0, 28.0, -45.0)[0]
    times = (0.0, 0.3, 0.7)
    scenes = {t: scene_at(name, t) for t in times}
    tracks = true_tracks(scenes.__getitem__, [(f"v{t}", t, pose) for t in times])
    movers = [scenes[0.0].primitives[i] for i in scenes[0.0].movers]
    starts = tracks.points[0].reshape(len(movers), POINTS_PER_THING, 3)
    paint = np.concatenate(
        [thing.paint(thing.local(own)) for thing, own in zip(movers, starts, strict=True)]
    )
    for k in (1, 2):
        seen = tracks.visible[k]
        scene = scenes[times[k]]
        dull = replace(
            scene, primitives=tuple(replace(thing, gloss=0.0) for thing in scene.primitives)
        )
        x, y = projected(tracks.points[k][seen], pose, 8 * SIZE).astype(int).T
        pixels = render_scene(dull, pose, 8 * SIZE, 1)[y, x, :3] / 255
        linear = np.where(pixels < 0.04045, pixels / 12.92, ((pixels + 0.055) / 1.055) ** 2.4)

        def fitting(own: np.ndarray, shown: np.ndarray = linear) -> float:
            light = (shown * own).sum(axis=1, keepdims=True) / (own**2).sum(axis=1, keepdims=True)
            return float((np.abs(shown - light * own).max(axis=1) < 0.02).mean())

        assert fitting(paint[seen]) > 0.85, "all but those at edges of the texture"
        assert fitting(np.roll(paint[seen], 7, axis=0)) < 0.45, (
            "the texture tells points from others"
        )


@pytest.mark.parametrize("name", NAMES)
def test_labels_are_of_the_thing_that_the_ray_of_a_pixel_hits_first(name: SceneName) -> None:
    scene = scene_at(name, 0.6)
    pose = orbit_cameras(1, 4.0, 28.0, -45.0)[0]
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    focal = 0.5 * SIZE / np.tan(0.5 * CAMERA_ANGLE_X)
    local = np.stack(
        [columns - 0.5 * SIZE, 0.5 * SIZE - rows, np.full_like(rows, -focal)], axis=-1
    ).reshape(-1, 3)
    directions = (local / np.linalg.norm(local, axis=1, keepdims=True) @ pose[:3, :3].T).astype(
        np.float32
    )
    hits = np.stack(
        [
            thing.intersect(pose[None, :3, 3].astype(np.float32), directions)
            for thing in scene.primitives
        ]
    )
    first = np.where(np.isfinite(hits.min(axis=0)), hits.argmin(axis=0), -1)
    expected = np.maximum(first - scene.movers.start + 1, 0).reshape(SIZE, SIZE)
    labels = render_things(scene, pose, SIZE, 1)
    assert (labels != expected).mean() < 1e-3, "but at outlines, by rounding"
    assert set(np.unique(labels)) == {0, *range(1, 1 + len(scene.movers))}


@pytest.mark.parametrize("name", ["roll", "room"])
def test_a_moving_camera_goes_along_a_smooth_arc_and_a_fixed_one_tests_it(
    name: SceneName, tmp_path: Path
) -> None:
    options = replace(TINY, size=4, num_times=30, num_test=6, style="moving")
    capture = _read(write_dynamic_capture(name, tmp_path / "out", options))
    train, test = (
        np.array([camera_center(v.cam_from_world) for v in capture.splits[s]])
        for s in ("train", "test")
    )
    assert [view.time for view in capture.splits["train"]] == pytest.approx(np.linspace(0, 1, 30))
    steps_deg = np.degrees(np.arccos((train[1:] * train[:-1]).sum(axis=1) / 16.0))
    assert 1.0 < steps_deg.min() < steps_deg.max() < 4.0, "no teleport"
    assert np.degrees(np.arccos((train[0] * train[-1]).sum() / 16.0)) > 50.0
    assert len(test) == 6
    assert (test == test[0]).all()
    assert not {view.time for view in capture.splits["test"]} & {
        view.time for view in capture.splits["train"]
    }
    assert capture.warnings == ()
    assert capture.has_alpha == (name == "roll")


@pytest.mark.parametrize(("name", "count"), [("roll", 4), ("room", 9)])
def test_fixed_cameras_each_see_all_times_of_any_scene(
    name: SceneName, count: int, tmp_path: Path
) -> None:
    root = tmp_path / "out"
    words = [
        "data",
        "synth",
        name,
        str(root),
        "--size",
        "4",
        "--views",
        "3",
        "--cameras",
        str(count),
    ]
    assert main(words) == 0
    capture = _read(root)
    seen = [(v.camera_id, v.time, v.cam_from_world.tobytes()) for v in capture.splits["train"]]
    assert {(camera, time) for camera, time, _ in seen} == {
        (c, t) for c in range(count) for t in (0.0, 0.5, 1.0)
    }
    assert len(seen) == 3 * count
    assert (
        len({pose for _, _, pose in seen})
        == len({(camera, pose) for camera, _, pose in seen})
        == count
    )
    assert {view.camera_id for view in capture.splits["test"]} == {count}
    assert capture.has_alpha == (name == "roll")
    assert inspect_capture(root, deep=True).problems == ()


def test_points_outside_the_image_or_behind_the_camera_are_not_in_it() -> None:
    points = np.array([[0, 0, -1], [0.35, 0, -1], [0.37, 0, -1], [0, 0, 1], [np.nan, 0, -1]])
    assert is_in_image(points, np.eye(4)).tolist() == [True, True, False, False, False]
