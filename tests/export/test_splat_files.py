"""Files of a run: where things are at each moment, its parts, sequences that are whole or not
there, tracks, bodies as nodes, cameras."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from moving_scene import (
    MOVING_ROWS,
    TRAIN_TIMES,
    Sliding,
    moved_x,
    moving_scene,
    row_of_balls,
    sliding_nodes,
    still_scene,
    write_moving_run,
)
from scene_kinds import KINDS, onlooker, scene_of_kind
from scipy.spatial.transform import Rotation, Slerp
from splat_scenes import cloud

from dyngs.cli import main
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, Lens, PointCloud
from dyngs.data.read import read_capture
from dyngs.deform.bodies.field import BodyField, BodyRestPose
from dyngs.deform.fields import WindowedField
from dyngs.deform.scene import DynamicScene
from dyngs.export.cameras import NAME, write_cameras
from dyngs.export.images import compare_file_with_run, compare_file_with_source
from dyngs.export.splat_files import (
    Part,
    WriteOptions,
    choose_write_options,
    find_up_direction,
    read_4dgs_frame,
    scene_part,
    splats_at,
    tracks_of,
    write_4dgs,
    write_rigid_bodies,
    write_run_sequence,
    write_run_splats,
    write_tracks,
)
from dyngs.gaussians.rendering import render
from dyngs.io.formats.formats import orient_to_axis, read_splats, write_splats
from dyngs.io.formats.similarity import AXES, Similarity, rotation_between
from dyngs.io.formats.splat_file import SplatFile
from dyngs.io.gltf import GltfFile
from dyngs.runs.opened import OpenedScene, SourceCapture, open_run, wrap_scene

ALL = (0, 1, 2, 3, 4)
STILL_ROWS = (0, 2, 4)


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> OpenedScene:
    return open_run(write_moving_run(tmp_path_factory.mktemp("moving"), offset=(100.0, 0.0, -5.0)))


@pytest.fixture(scope="module")
def near(tmp_path_factory: pytest.TempPathFactory) -> OpenedScene:
    return open_run(write_moving_run(tmp_path_factory.mktemp("near")))


def x_of(path: Path) -> torch.Tensor:
    return read_splats(path).gaussians.means[:, 0]


@pytest.mark.parametrize("time", [0.0, 0.3, 1.0])
def test_one_moment(moving: OpenedScene, time: float, tmp_path: Path) -> None:
    splat = read_splats(write_run_splats(moving, tmp_path / "a.ply", time).path)
    torch.testing.assert_close(splat.gaussians.means[:, 0], moved_x(ALL, time))
    assert torch.equal(splat.gaussians.means[:, 1:], row_of_balls().means[:, 1:])
    assert f"dyngs time {time!r}" in splat.comments
    assert splat.world_offset == (100.0, 0.0, -5.0)
    assert splat.eps2d == moving.config.model.eps2d


def test_parts_together_are_the_whole(moving: OpenedScene, tmp_path: Path) -> None:
    parts: dict[Part, tuple[int, ...]] = {"moving": MOVING_ROWS, "static": STILL_ROWS}
    for part, rows in parts.items():
        path = write_run_splats(moving, tmp_path / f"{part}.ply", 0.7, part).path
        torch.testing.assert_close(x_of(path), moved_x(rows, 0.7))
    assert not any("time" in comment for comment in read_splats(tmp_path / "static.ply").comments)
    with pytest.raises(DyngsError, match="nothing moves in this run"):
        scene_part(still_scene(), "moving")
    with pytest.raises(DyngsError, match="no static part"):
        scene_part(moving_scene(Sliding(), ALL), "static")


@pytest.mark.parametrize(("part", "rows"), [("all", ALL), ("moving", MOVING_ROWS)])
def test_a_sequence(moving: OpenedScene, part: Part, rows: tuple[int, ...], tmp_path: Path) -> None:
    times = (0.0, 0.25, 1.0)
    files = write_run_sequence(moving, tmp_path / "new" / "seq", times, part)
    paths = [one.path for one in files]
    assert [p.name for p in paths] == ["frame_0000.ply", "frame_0001.ply", "frame_0002.ply"]
    assert sorted((tmp_path / "new" / "seq").iterdir()) == paths
    for path, time in zip(paths, times, strict=True):
        torch.testing.assert_close(x_of(path), moved_x(rows, time))
        assert f"dyngs time {time!r}" in read_splats(path).comments


def test_a_sequence_of_the_same_length_is_replaced_and_others_are_refused(
    moving: OpenedScene, tmp_path: Path
) -> None:
    folder = tmp_path / "seq"
    write_run_sequence(moving, folder, (0.0, 0.5))
    (folder / "notes.txt").write_text("mine")
    longer = [one.path for one in write_run_sequence(moving, folder, (1.0, 1.0, 1.0))]
    assert all(torch.equal(x_of(path), x_of(longer[0])) for path in longer)
    before = {p: p.read_bytes() for p in folder.iterdir()}
    with pytest.raises(DyngsError, match=r"contains other \.ply files \(frame_0002\.ply\)"):
        write_run_sequence(moving, folder, (0.0, 0.5))
    assert {p: p.read_bytes() for p in folder.iterdir()} == before
    with pytest.raises(DyngsError, match=r"notes\.txt"):
        write_run_sequence(moving, folder / "notes.txt", (0.0, 0.5))


def test_up_is_what_the_cameras_or_the_user_say(near: OpenedScene) -> None:
    found = find_up_direction(near)
    assert found is not None
    name = next(name for name, axis in AXES.items() if axis == found[0])
    how, line = choose_write_options(near, "y")
    assert how.turn == rotation_between(found[0], AXES["y"])
    assert f"rotated from {name} in the capture" in line or name == "y"
    assert "axes of the capture kept" in choose_write_options(near, name)[1]
    lost = replace(near, captured=SourceCapture(near.config.data, DyngsError("gone")))
    assert find_up_direction(lost) is None
    how, line = choose_write_options(lost, "y", sh_degree=2)
    assert (how.turn, how.up, how.sh_degree) == ((1.0, 0.0, 0.0, 0.0), None, 2)
    assert "set it with --from-up=AXIS" in line
    assert choose_write_options(lost, "y", from_up="z")[0].turn == rotation_between(
        AXES["z"], AXES["y"]
    )
    assert choose_write_options(lost, "y", "keep", "z")[0].turn == (1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_edits_of_every_kind_of_scene_are_exact(kind: str) -> None:
    """Scenes that move, are posed or have a 3D filter, rendered between two time steps by cameras
    that are transformed with them."""
    scene = replace(scene_of_kind(kind), colour=None)
    edit = Similarity((0.6, 0.0, 0.8, 0.0), 2.5, (3.0, -1.0, 0.5))
    splat = splats_at(wrap_scene(scene), scene, 0.3, WriteOptions(edit=edit, up="y"))
    seen = onlooker()
    before = scene.render(seen, 0.3, background=torch.zeros(3)).rgb
    options = replace(scene.options, near=scene.options.near * edit.scale)
    after = render(splat.gaussians, edit.cameras(seen), options).rgb
    assert float(before.max()) > 0.05
    torch.testing.assert_close(after, before, rtol=0, atol=2e-4)
    assert (splat.edited, splat.up) == (edit, "y")


def test_a_file_drawn_again_is_compared_with_its_run(near: OpenedScene, tmp_path: Path) -> None:
    for how in (WriteOptions(), WriteOptions(rotation_between(AXES["z"], AXES["-y"]), "-y")):
        written = write_run_splats(near, tmp_path / "a.ply", 0.7, how=how)
        read = read_splats(written.path)
        assert compare_file_with_run(near, near.scene, 0.7, written.splat, read) > 80
        # another time is seen as such
        assert compare_file_with_run(near, near.scene, 0.0, written.splat, read) < 40
    splat = SplatFile(cloud(300), up="z")
    exact = write_splats(tmp_path / "a.ply", orient_to_axis(splat, None, tmp_path / "a.ply"))
    assert compare_file_with_source(splat, exact) > 80
    assert compare_file_with_source(splat, write_splats(tmp_path / "a.splat", splat)) < 30


def expected(times: tuple[float, ...], speed: float = 1.0) -> np.ndarray:
    """(5, T, 3) where the balls of ``moving_scene(Sliding(speed))`` are."""
    wanted = np.repeat(row_of_balls().means.numpy()[:, None], len(times), axis=1)
    wanted[list(MOVING_ROWS), :, 0] += speed * np.array(times, np.float32)
    return wanted


def test_tracks_are_the_positions_of_the_scene() -> None:
    times = (0.0, 1.0, 0.3)
    tracks = tracks_of(moving_scene(Sliding(-3.0)), times)
    assert tracks.positions.dtype == np.float32
    np.testing.assert_allclose(tracks.positions, expected(times, -3.0), atol=1e-5)
    assert (tracks.times.tolist(), tracks.times.dtype) == (list(times), np.float64)
    assert tracks.moving.tolist() == [False, True, False, True, False]
    assert tracks.ids.tolist() == [0, 1, 2, 3, 4]
    assert tracks.visible.all()
    part = tracks_of(moving_scene(Sliding()), TRAIN_TIMES, part="moving")
    wanted = expected(TRAIN_TIMES)[list(MOVING_ROWS)]
    np.testing.assert_allclose(part.positions, wanted, atol=1e-6)
    assert (part.moving.tolist(), part.ids.tolist()) == ([True, True], list(MOVING_ROWS))
    with pytest.raises(DyngsError, match="nothing moves"):
        tracks_of(still_scene(), TRAIN_TIMES, part="moving")
    assert not tracks_of(still_scene(), (0.0, 1.0)).moving.any()
    # of map coordinates, float32 would keep half a metre
    offset = (500_000.25, 5_400_000.125, 0.0)
    far = tracks_of(moving_scene(Sliding()), TRAIN_TIMES, Similarity(shift=offset)).positions
    assert far.dtype == np.float64
    np.testing.assert_allclose(far - np.array(offset), expected(TRAIN_TIMES), atol=1e-6)


def test_a_file_of_tracks_holds_arrays_without_pickle(tmp_path: Path) -> None:
    tracks = tracks_of(moving_scene(Sliding()), TRAIN_TIMES)
    path = write_tracks(tmp_path / "new" / "tracks.npz", tracks)
    with np.load(path, allow_pickle=False) as stored:
        assert sorted(stored.files) == ["ids", "moving", "positions", "times", "visible"]
        for name in stored.files:
            np.testing.assert_array_equal(stored[name], getattr(tracks, name), strict=True)
    first = path.read_bytes()
    assert write_tracks(path, tracks).read_bytes() == first
    broken = tracks_of(moving_scene(Sliding(float("nan"))), TRAIN_TIMES)
    with pytest.raises(DyngsError, match="not finite"):
        write_tracks(path, broken)
    assert path.read_bytes() == first


def test_moving_files(
    tmp_path: Path, near: OpenedScene, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("fourdgs")
    times = [i / 9 for i in range(10)]  # more than one group of key frame and deltas
    splats, _ = write_4dgs(near, tmp_path / "a.4dgs", times)
    for i in (0, 3, 8, 9):
        read = read_4dgs_frame(tmp_path / "a.4dgs", i).gaussians
        meant = splats[i].gaussians
        torch.testing.assert_close(read.means[:, 0], moved_x(ALL, times[i]), rtol=0, atol=0.01)
        torch.testing.assert_close(read.base_rgb, meant.base_rgb.clamp(0, 1), rtol=0, atol=0.01)
        torch.testing.assert_close(read.scales, meant.scales, rtol=0.02, atol=0)
    run = str(near.path)
    assert main(["export", run, "--times", "0:1:3", "--out", str(tmp_path / "b.4dgs")]) == 0
    told = capsys.readouterr().out
    assert "3 times, each shown for 1/30 s" in told
    assert "drawn again" in told
    assert main(["export", run, "--sh-degree", "3", "--out", str(tmp_path / "c.4dgs")]) == 2


@pytest.fixture(scope="module")
def rolling(tmp_path_factory: pytest.TempPathFactory) -> OpenedScene:
    """Of five balls the second and the fourth are one body, which turns by 0.9 times half a turn
    and moves aside."""
    opened = open_run(write_moving_run(tmp_path_factory.mktemp("rolling")))
    angles = torch.linspace(-0.6, 1.1, 9) * np.pi / 2
    quats = torch.stack([angles.cos(), angles.sin() * 0.6, 0 * angles, angles.sin() * 0.8], dim=1)
    way = torch.linspace(0, 1, 9)
    places = torch.stack([2 * way - 1, 0.25 * way**2, 0 * way], dim=1)
    labels = torch.zeros(len(MOVING_ROWS), dtype=torch.long)
    rest = BodyRestPose(torch.tensor([[0.1, 0.2, 0.0]]), torch.ones(1), labels)
    field = BodyField(sliding_nodes(), rest, {"places": places[None], "quats": quats[None]})
    assert isinstance(opened.scene, DynamicScene)
    return opened.with_scene(replace(opened.scene, field=WindowedField(field, len(MOVING_ROWS))))


@pytest.mark.parametrize("how", [WriteOptions(), WriteOptions((0.5, 0.5, 0.5, 0.5), "y")])
def test_the_animation_of_bodies_shows_the_scene_at_all_times(
    tmp_path: Path, rolling: OpenedScene, how: WriteOptions
) -> None:
    written = write_rigid_bodies(rolling, tmp_path / "a.glb", 0.25, how)
    found = read_splats(written.path).gaussians
    order = [*MOVING_ROWS, *STILL_ROWS]  # the reader begins with the last node
    for name, x in found.tensors().items():  # without the animation
        wanted = written.splat.gaussians.tensors()[name][order]
        torch.testing.assert_close(x, wanted, atol=1e-5, rtol=0)
    assert any("bodies: 1" in note for note in written.notes)
    file = GltfFile(written.path)
    rest, body = file.nodes
    assert (rest["name"], body["name"]) == ("rest", "body 0")
    animation = file.json["animations"][0]
    samples = {}
    for channel in animation["channels"]:
        assert channel["target"]["node"] == 1
        sampler = animation["samplers"][channel["sampler"]]
        kind = {"translation": "VEC3", "rotation": "VEC4"}[channel["target"]["path"]]
        seconds = file.numbers(sampler["input"], "SCALAR", np.float64)[:, 0]
        samples[channel["target"]["path"]] = file.numbers(sampler["output"], kind, np.float64)
    assert seconds[-1] == pytest.approx(rolling.seconds)
    assert (samples["rotation"][1:] * samples["rotation"][:-1]).sum(1).min() > 0
    turns = Slerp(seconds, Rotation.from_quat(samples["rotation"]))
    local = found.means[:2].numpy() - np.array(body["translation"])
    for time in (0.0, 0.25, 0.3, 0.875):
        now = time * rolling.seconds
        place = np.array([np.interp(now, seconds, samples["translation"][:, k]) for k in range(3)])
        means = splats_at(rolling, rolling.scene, time, how).gaussians.means[list(MOVING_ROWS)]
        atol = 1e-5 if time != 0.3 else 0.02  # between two poses of the file
        np.testing.assert_allclose(turns(now).apply(local) + place, means.numpy(), atol=atol)


@pytest.fixture
def far_capture(still: Path) -> Capture:
    """A capture whose world is far away, with a lens of another kind for each of its first
    views."""
    lenses = [
        Lens(),
        Lens("opencv", (0.1, -0.02, 0.001, 0.002)),
        Lens("opencv", (0.1,) * 8),
        Lens("fisheye", (0.01,) * 4),
    ]
    found = read_capture(still)
    views = []
    for i, view in enumerate(found.splits["train"]):
        mask = view.image_path if i == 1 else None
        views.append(replace(view, lens=lenses[i % 4], camera_id=i, mask_path=mask, time=i / 10))
    random = np.random.default_rng(0)
    cloud = PointCloud(random.normal(size=(5, 3)), random.integers(0, 255, (5, 3)).astype(np.uint8))
    splits = {**found.splits, "train": tuple(views)}
    offset = np.array([10.0, 0, -20])
    return replace(
        found, splits=splits, points=cloud, world_offset=offset, file_time_span=(2.0, 4.0)
    )


def test_a_written_capture_is_read_as_it_was(far_capture: Capture, tmp_path: Path) -> None:
    capture = far_capture
    path = write_cameras(tmp_path / "out" / NAME, capture, {"train": capture.splits["train"]})
    times = [frame["time"] for frame in json.loads(path.read_text())["frames"]]
    np.testing.assert_allclose(times, [2 + 2 * i / 10 for i in range(len(times))])
    back = read_capture(DataConfig(root=tmp_path / "out", follow_links=True, test_every=0))
    assert back.points is not None
    assert capture.points is not None
    np.testing.assert_allclose(back.points.xyz, capture.points.xyz + capture.world_offset)
    np.testing.assert_array_equal(back.points.rgb, capture.points.rgb)
    views = {view.image_path.resolve(): view for view in back.splits["train"]}
    assert len(views) == len(times)
    for view in capture.splits["train"]:
        same = views[view.image_path.resolve()]
        shift = np.eye(4)
        shift[:3, 3] = capture.world_offset
        found = same.cam_from_world @ shift
        np.testing.assert_allclose(found, view.cam_from_world, atol=1e-9)
        np.testing.assert_allclose(same.intrinsics, view.intrinsics)
        assert (same.lens, same.camera_id) == (view.lens, view.camera_id)
        assert (same.mask_path is None) == (view.mask_path is None)
