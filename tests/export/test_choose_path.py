"""Chosen camera paths: times along them, fixed cameras, views by name, and scenes without
cameras."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from moving_scene import TEST_TIMES, TRAIN_TIMES, write_moving_run
from scaled_files import FACTORS, write_scaled

from dyngs.api.train import train
from dyngs.config import Config, DataConfig, RunConfig, TrainConfig
from dyngs.core.conventions import RasterizeMode
from dyngs.core.errors import DyngsError
from dyngs.data.loader import ImageLoader
from dyngs.export.choose_path import PathOptions, choose_path, orbit_cameras_around, select_view
from dyngs.gaussians import Gaussians
from dyngs.gaussians.static_scene import StaticScene
from dyngs.human.keys import HumanModel
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture
from dyngs.io.formats.formats import write_splats
from dyngs.io.formats.splat_file import SplatFile
from dyngs.runs.opened import OpenedScene, cameras_for_paths, open_run, open_scene, wrap_scene

MODEL = HumanModel(resolution=24, sh_degree=0, fit=False)
TRAIN = TrainConfig(steps=1)


@pytest.fixture(scope="module")
def moving_run(tmp_path_factory: pytest.TempPathFactory) -> OpenedScene:
    return open_run(write_moving_run(tmp_path_factory.mktemp("moving")))


@pytest.fixture(scope="module")
def still_run(tmp_path_factory: pytest.TempPathFactory) -> OpenedScene:
    return open_run(write_moving_run(tmp_path_factory.mktemp("still"), moves=False))


@pytest.mark.parametrize("name", ["orbit", "spiral"])
def test_time_advances_along_a_path_by_default(
    name: str, moving_run: OpenedScene, still_run: OpenedScene
) -> None:
    path = choose_path(moving_run, PathOptions(name, 5))
    assert path.times == (0.0, 0.25, 0.5, 0.75, 1.0)
    assert len(path.notes) == 1
    assert "from 0 to 1" in path.notes[0]
    frozen = choose_path(moving_run, PathOptions(name, 5, times=(0.4,)))
    assert frozen.times == (0.4,) * 5
    assert torch.equal(frozen.cameras.cam_from_world, path.cameras.cam_from_world)
    together = choose_path(moving_run, PathOptions(name, 3, times=(1.0, 0.5, 0.0)))
    assert together.times == (1.0, 0.5, 0.0)
    assert (frozen.notes, together.notes) == ((), ())
    still = choose_path(still_run, PathOptions(name, 3))
    assert (still.times, still.notes) == (None, ())


def test_times_of_a_file_are_overridden(moving_run: OpenedScene, tmp_path: Path) -> None:
    cameras = cameras_for_paths(moving_run.capture.splits["train"], moving_run.config.data)
    file = tmp_path / "path.json"
    frames = [
        {"cam_from_world": pose, "time": 0.1 * i}
        for i, pose in enumerate(cameras.cam_from_world.tolist(), start=1)
    ]
    document = {"width": 16, "height": 16, "fps": 12, "fl_x": 16, "frames": frames}
    file.write_text(json.dumps(document))
    own = choose_path(moving_run, PathOptions(str(file)))
    assert own.times == pytest.approx((0.1, 0.2, 0.3, 0.4, 0.5))
    assert (own.fps, own.notes) == (12.0, ())
    assert choose_path(moving_run, PathOptions(str(file), times=(0.7,))).times == (0.7,) * 5
    given = (0.0, 0.0, 1.0, 1.0, 0.5)
    assert choose_path(moving_run, PathOptions(str(file), times=given)).times == given
    with pytest.raises(DyngsError, match="5 cameras but 3 times"):
        choose_path(moving_run, PathOptions(str(file), times=(0.0, 0.5, 1.0)))


def test_a_camera_that_stands_still(moving_run: OpenedScene) -> None:
    capture = moving_run.capture
    wanted = ImageLoader(capture.splits["test"], DataConfig(root=capture.root))[1]
    path = choose_path(moving_run, PathOptions(None, times=(0.0, 0.5, 1.0), view="1"))
    assert path.times == (0.0, 0.5, 1.0)
    assert (path.cameras.width, path.cameras.height) == (16, 16)
    for i in range(3):
        torch.testing.assert_close(path.cameras.cam_from_world[i], wanted.cameras.cam_from_world[0])
        torch.testing.assert_close(path.cameras.intrinsics[i], wanted.cameras.intrinsics[0])
    assert choose_path(moving_run, PathOptions(None, view="1")).times == (TEST_TIMES[1],)
    assert choose_path(moving_run, PathOptions(None, split="train", view="1")).times == (
        TRAIN_TIMES[1],
    )
    small = choose_path(moving_run, PathOptions(None, times=(0.5,), size=(8, 4))).cameras
    assert (len(small), small.width, small.height) == (1, 8, 4)


def test_views_are_found_by_name_image_and_number(moving_run: OpenedScene) -> None:
    capture = moving_run.capture
    test = capture.splits["test"]
    train = capture.splits["train"]
    assert select_view(capture) is test[0]
    assert select_view(capture, test[2].name) is test[2]
    assert select_view(capture, "r_002") is test[2]
    assert select_view(capture, "2") is test[2]
    # no split given: names are looked for in all
    assert select_view(capture, train[3].name) is train[3]
    assert select_view(capture, "r_004") is train[4]
    assert select_view(capture, "4", "train") is train[4]
    assert select_view(capture.replace(splits={"train": train, "test": ()})) is train[0]
    for name, split in (("9", None), ("r_9", None), ("-1", None), (train[0].name, "test")):
        with pytest.raises(
            DyngsError, match=rf"unknown view .{name}.; split test has 3 views, .*\(0\) to .*\(2\)"
        ):
            select_view(capture, name, split)
    with pytest.raises(DyngsError, match="'val' has no views"):
        select_view(capture, None, "val")


def some_gaussians(count: int = 50) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=generator)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    return Gaussians(
        means, quats, torch.full((count, 3), -3.0), torch.zeros(count), torch.zeros(count, 1, 3)
    )


@pytest.mark.parametrize("path", ["orbit", "spiral"])
@pytest.mark.parametrize(("up", "axis"), [("z", (0.0, 0.0, 1.0)), ("-y", (0.0, -1.0, 0.0))])
def test_a_bare_file_is_upright(
    path: str, up: str, axis: tuple[float, ...], tmp_path: Path
) -> None:
    splat = SplatFile(some_gaussians(), RasterizeMode.ANTIALIASED, 0.1)
    opened = replace(open_scene(write_splats(tmp_path / "a.ply", splat).path), stated_up=up)
    chosen = choose_path(opened, PathOptions(path, num_frames=5, size=(80, 60)))
    assert (chosen.cameras.width, chosen.cameras.height, chosen.times) == (80, 60, None)
    assert float((-chosen.cameras.cam_from_world[:, 1, :3] @ torch.tensor(axis)).min()) > 0.5
    options = opened.scene.options
    assert (options.mode, options.eps2d) == (RasterizeMode.ANTIALIASED, 0.1)


@pytest.mark.parametrize("factor", FACTORS)
def test_an_orbit_shows_the_same_frames_in_any_unit(factor: float, tmp_path: Path) -> None:
    source = write_splats(tmp_path / "a.ply", SplatFile(some_gaussians(), up="z")).path
    frames = []
    centers = []
    for file, unit in ((source, 1.0), (write_scaled(tmp_path / "b.ply", source, factor), factor)):
        opened = open_scene(file)
        cameras = choose_path(opened, PathOptions("orbit", num_frames=3, size=(80, 60))).cameras
        frames.append(opened.renderable.render(cameras).rgb)
        centers.append(cameras.centers / unit)
    torch.testing.assert_close(centers[1], centers[0], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(frames[1], frames[0], rtol=0, atol=2e-3)


def test_a_single_gaussian_is_in_view_whole() -> None:
    one = wrap_scene(StaticScene(gaussians=some_gaussians(1)))
    size = math.exp(-3)
    distance = float(
        (orbit_cameras_around(one, 1).centers[0] - one.scene.gaussians.means[0]).norm()
    )
    assert size < distance < 10 * size


@pytest.mark.parametrize(
    "options", [PathOptions(times=(0.5,)), PathOptions(None), PathOptions(view="0")]
)
def test_a_file_has_neither_times_nor_views(options: PathOptions, tmp_path: Path) -> None:
    file = write_splats(tmp_path / "a.ply", SplatFile(some_gaussians())).path
    with pytest.raises(DyngsError, match=r"a \.ply has no times and no views"):
        choose_path(open_scene(file), options)


def directions(centers: torch.Tensor) -> np.ndarray:
    """Angles about the vertical, degrees, of cameras seen from their middle."""
    x, _, z = (centers - centers.mean(0)).double().numpy().T
    return np.sort(np.degrees(np.arctan2(x, z)) % 360)


def test_a_person_filmed_from_one_side_gets_a_full_orbit(tmp_path: Path) -> None:
    options = HumanOptions(
        size=32, num_frames=2, num_pose_frames=0, num_cameras=1, num_test=1, samples=1
    )
    root = write_human_capture(tmp_path / "person", options)
    run = RunConfig(threads=1, dir=tmp_path / "run")
    folder = train(
        Config(data=DataConfig(root=root, test_every=0), model=MODEL, train=TRAIN, run=run)
    )
    path = choose_path(open_run(folder), PathOptions("orbit", 4))
    assert np.diff(directions(path.cameras.centers)) == pytest.approx(90, abs=1)
    assert any("is a full circle" in note for note in path.notes)
