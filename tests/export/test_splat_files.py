"""Files of a run: where things are at each moment, its parts, sequences that are whole or not
there."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scene import (
    MOVING_ROWS,
    TRAIN_TIMES,
    Sliding,
    moved_x,
    moving_scene,
    row_of_balls,
    still_scene,
    write_moving_run,
)
from scene_kinds import KINDS, onlooker, scene_of_kind

from dyngs.cli import main
from dyngs.core.errors import DyngsError
from dyngs.export import splat_files
from dyngs.export.splat_files import (
    Part,
    Tracks,
    Writing,
    frame_names,
    read_moment,
    scene_part,
    splats_at,
    tracks_of,
    up_of,
    write_moving,
    write_run_sequence,
    write_run_splats,
    write_tracks,
    writing_of,
)
from dyngs.gaussians.rendering import render
from dyngs.io.formats.formats import read_splats
from dyngs.io.formats.similarity import AXES, Similarity, turn_between
from dyngs.runs.opened import Captured, Opened, open_run, opened_scene
from dyngs.static.scene import StaticScene

ALL = (0, 1, 2, 3, 4)
STILL_ROWS = (0, 2, 4)


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Opened:
    return open_run(write_moving_run(tmp_path_factory.mktemp("moving"), offset=(100.0, 0.0, -5.0)))


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Opened:
    return open_run(write_moving_run(tmp_path_factory.mktemp("still"), moves=False))


def written(run: Opened, path: Path, time: float = 0.0, part: Part = "all") -> Path:
    return write_run_splats(run, path, time, part).path


def x_of(path: Path) -> torch.Tensor:
    return read_splats(path).gaussians.means[:, 0]


@pytest.mark.parametrize("time", [0.0, 0.3, 1.0])
def test_one_moment(moving: Opened, time: float, tmp_path: Path) -> None:
    splat = read_splats(written(moving, tmp_path / "a.ply", time))
    torch.testing.assert_close(splat.gaussians.means[:, 0], moved_x(ALL, time))
    assert torch.equal(splat.gaussians.means[:, 1:], row_of_balls().means[:, 1:])
    assert f"dyngs time {time!r}" in splat.comments
    assert splat.world_offset == (100.0, 0.0, -5.0)
    assert splat.eps2d == moving.config.model.eps2d


def test_a_still_run_has_no_time(still: Opened, tmp_path: Path) -> None:
    early, late = (written(still, tmp_path / f"{time}.ply", time) for time in (0.0, 1.0))
    assert early.read_bytes() == late.read_bytes()
    assert not any("time" in comment for comment in read_splats(early).comments)
    everything = written(still, tmp_path / "still.ply", part="still")
    assert everything.read_bytes() == early.read_bytes()


def test_the_default_is_the_beginning(tmp_path: Path) -> None:
    run_dir = write_moving_run(tmp_path)
    torch.testing.assert_close(
        x_of(written(open_run(run_dir), tmp_path / "a.ply")), moved_x(ALL, 0.0)
    )


def test_parts_together_are_the_whole(moving: Opened, tmp_path: Path) -> None:
    for time in (0.0, 0.7):
        moves = x_of(written(moving, tmp_path / "moving.ply", time, "moving"))
        stays = x_of(written(moving, tmp_path / "still.ply", time, "still"))
        torch.testing.assert_close(moves, moved_x(MOVING_ROWS, time))
        torch.testing.assert_close(stays, moved_x(STILL_ROWS, time))
    assert not any("time" in comment for comment in read_splats(tmp_path / "still.ply").comments)


def test_empty_parts_are_refused() -> None:
    with pytest.raises(DyngsError, match="nothing moves in this run"):
        scene_part(still_scene(), "moving")
    with pytest.raises(DyngsError, match="every Gaussian of this run moves"):
        scene_part(moving_scene(Sliding(), ALL), "still")


@pytest.mark.parametrize(("part", "rows"), [("all", ALL), ("moving", MOVING_ROWS)])
def test_a_sequence(moving: Opened, part, rows: tuple[int, ...], tmp_path: Path) -> None:
    times = (0.0, 0.25, 1.0)
    files = write_run_sequence(moving, tmp_path / "new" / "seq", times, part)
    paths = [one.path for one in files]
    assert [p.name for p in paths] == ["frame_0000.ply", "frame_0001.ply", "frame_0002.ply"]
    assert sorted((tmp_path / "new" / "seq").iterdir()) == paths
    assert all(re.fullmatch(r"(.*?)(\d+)\.ply", p.name) for p in paths)  # what players look for
    for path, time in zip(paths, times, strict=True):
        torch.testing.assert_close(x_of(path), moved_x(rows, time))
        assert f"dyngs time {time!r}" in read_splats(path).comments


@pytest.mark.parametrize(
    ("count", "last"),
    [(1, "frame_0000.ply"), (10_000, "frame_9999.ply"), (10_001, "frame_10000.ply")],
)
def test_names_are_in_order_of_frames(count: int, last: str) -> None:
    names = frame_names(count)
    assert (len(set(names)), names[-1]) == (count, last)
    assert sorted(names) == names


def test_a_sequence_of_the_same_length_is_replaced_and_others_are_refused(
    moving: Opened, tmp_path: Path
) -> None:
    folder = tmp_path / "seq"
    write_run_sequence(moving, folder, (0.0, 0.5))
    (folder / "notes.txt").write_text("mine")
    longer = [one.path for one in write_run_sequence(moving, folder, (1.0, 1.0, 1.0))]
    assert all(torch.equal(x_of(path), x_of(longer[0])) for path in longer)
    before = {p: p.read_bytes() for p in folder.iterdir()}
    with pytest.raises(DyngsError, match=r"holds other \.ply files \(frame_0002\.ply\)"):
        write_run_sequence(moving, folder, (0.0, 0.5))
    assert {p: p.read_bytes() for p in folder.iterdir()} == before
    with pytest.raises(DyngsError, match="is a file, but a sequence needs a folder"):
        write_run_sequence(moving, folder / "notes.txt", (0.0, 0.5))


@pytest.mark.parametrize(
    "problem", [DyngsError("NaN"), OSError(28, "No space left on device"), KeyboardInterrupt()]
)
@pytest.mark.parametrize("exists", [False, True])
def test_a_sequence_that_fails_leaves_nothing(
    moving: Opened,
    problem: BaseException,
    exists: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = tmp_path / "seq"
    real = splat_files.write_splats
    count = []
    if exists:
        folder.mkdir()
        (folder / "notes.txt").write_text("mine")

    def failing(*arguments, **options):
        count.append(1)
        if len(count) == 3:
            raise problem
        return real(*arguments, **options)

    monkeypatch.setattr(splat_files, "write_splats", failing)
    with pytest.raises(DyngsError if isinstance(problem, OSError) else type(problem)):
        write_run_sequence(moving, folder, (0.0, 0.25, 0.5, 0.75))
    assert len(count) == 3
    assert [p.name for p in tmp_path.rglob("*")] == (["seq", "notes.txt"] if exists else [])


@pytest.fixture
def run(tmp_path: Path) -> Opened:
    return open_run(write_moving_run(tmp_path))


def test_the_cameras_know(run: Opened) -> None:
    found = up_of(run)
    assert found is not None
    assert found[0] in AXES.values()
    name = next(name for name, axis in AXES.items() if axis == found[0])
    how, line = writing_of(run, "y")
    assert how.turn == turn_between(found[0], AXES["y"])
    assert f"it was {name} in the capture" in line or name == "y"
    assert "the axes of the capture are kept" in writing_of(run, name)[1]


def test_without_a_capture_nothing_is_turned(run: Opened) -> None:
    lost = replace(
        run, captured=Captured(run.config.data.model_copy(update={"root": Path("no")}), run.info)
    )
    assert up_of(lost) is None
    how, line = writing_of(lost, "y", sh_degree=2)
    assert (how.turn, how.up, how.sh_degree) == ((1.0, 0.0, 0.0, 0.0), None, 2)
    assert "--from-up=AXIS tells it" in line
    told, _ = writing_of(lost, "y", from_up="z")
    assert told.turn == turn_between(AXES["z"], AXES["y"])
    assert writing_of(lost, "y", "keep", "z")[0].turn == (1.0, 0.0, 0.0, 0.0)


def expected(times: tuple[float, ...], speed: float = 1.0) -> np.ndarray:
    """(5, T, 3) where the balls of ``moving_scene(Sliding(speed))`` are."""
    wanted = np.repeat(row_of_balls().means.numpy()[:, None], len(times), axis=1)
    wanted[list(MOVING_ROWS), :, 0] += speed * np.array(times, np.float32)
    return wanted


@settings(max_examples=20, deadline=None)
@given(times=st.lists(st.floats(0, 1), min_size=1, max_size=5).map(tuple), speed=st.floats(-10, 10))
def test_positions_are_those_of_the_scene(times: tuple[float, ...], speed: float) -> None:
    tracks = tracks_of(moving_scene(Sliding(speed)), times)
    assert tracks.positions.dtype == np.float32
    np.testing.assert_allclose(tracks.positions, expected(times, speed), atol=1e-5)
    assert tracks.times.tolist() == list(times)
    assert tracks.times.dtype == np.float64
    assert tracks.moving.tolist() == [False, True, False, True, False]
    assert tracks.ids.tolist() == [0, 1, 2, 3, 4]


def test_only_what_moves() -> None:
    tracks = tracks_of(moving_scene(Sliding()), TRAIN_TIMES, part="moving")
    np.testing.assert_allclose(
        tracks.positions, expected(TRAIN_TIMES)[list(MOVING_ROWS)], atol=1e-6
    )
    assert tracks.moving.tolist() == [True, True]
    assert tracks.ids.tolist() == list(MOVING_ROWS)
    with pytest.raises(DyngsError, match="nothing moves"):
        tracks_of(still_scene(), TRAIN_TIMES, part="moving")


def test_the_whole_scene_may_move_or_stand() -> None:
    every = tracks_of(moving_scene(Sliding(), (0, 1, 2, 3, 4)), (0.0, 1.0))
    np.testing.assert_allclose(every.positions[:, 1, 0], row_of_balls().means[:, 0] + 1)
    assert every.moving.all()
    none = tracks_of(still_scene(), (0.0, 1.0))
    np.testing.assert_array_equal(none.positions[:, 0], none.positions[:, 1])
    assert not none.moving.any()


def test_far_scenes_keep_their_precision() -> None:
    """Of map coordinates, float32 would keep half a metre."""
    offset = (500_000.25, 5_400_000.125, 0.0)
    tracks = tracks_of(moving_scene(Sliding()), TRAIN_TIMES, Similarity(shift=offset))
    assert tracks.positions.dtype == np.float64
    np.testing.assert_allclose(
        tracks.positions - np.array(offset), expected(TRAIN_TIMES), atol=1e-6
    )


def test_a_file_holds_arrays_without_pickle(tmp_path: Path) -> None:
    tracks = tracks_of(moving_scene(Sliding()), TRAIN_TIMES)
    path = write_tracks(tmp_path / "new" / "tracks.npz", tracks)
    with np.load(path, allow_pickle=False) as stored:
        assert sorted(stored.files) == ["ids", "moving", "positions", "times"]
        for name in stored.files:
            np.testing.assert_array_equal(stored[name], getattr(tracks, name), strict=True)
    first = path.read_bytes()
    assert write_tracks(path, tracks).read_bytes() == first
    assert [p.name for p in path.parent.iterdir()] == ["tracks.npz"]


def test_nothing_is_written_of_positions_that_are_not_finite(tmp_path: Path) -> None:
    tracks = tracks_of(moving_scene(Sliding(float("nan"))), TRAIN_TIMES)
    with pytest.raises(DyngsError, match="not finite"):
        write_tracks(tmp_path / "tracks.npz", tracks)
    assert not any(tmp_path.iterdir())


def test_sizes_beyond_the_limit_are_refused_before_memory_is_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(splat_files, "MAX_BYTES", 5 * 4 * 3 * 4)
    assert tracks_of(moving_scene(Sliding()), (0.0,) * 4).positions.nbytes == 5 * 4 * 3 * 4
    with pytest.raises(
        DyngsError, match=r"tracks of 5 Gaussians at 5 times .* fewer --times, or --dynamic"
    ):
        tracks_of(moving_scene(Sliding()), (0.0,) * 5)
    monkeypatch.undo()
    with pytest.raises(DyngsError, match=r"6\.0 GB"):
        tracks_of(StaticScene(gaussians=row_of_balls(5)), range(100_000_000))


def test_fields_are_the_arrays_of_the_file() -> None:
    assert set(Tracks.__dataclass_fields__) == {"positions", "times", "moving", "ids"}


def test_every_moment_is_where_it_should_be(tmp_path: Path) -> None:
    pytest.importorskip("fourdgs")
    run = open_run(write_moving_run(tmp_path / "run"))
    times = [i / 9 for i in range(10)]  # more than one group of key frame and deltas
    written = write_moving(run, tmp_path / "a.4dgs", times)
    for i in (0, 3, 8, 9):
        read = read_moment(written.path, i).gaussians
        torch.testing.assert_close(
            read.means[:, 0], moved_x((0, 1, 2, 3, 4), times[i]), rtol=0, atol=0.01
        )
        torch.testing.assert_close(
            read.base_rgb, written.splats[i].gaussians.base_rgb.clamp(0, 1), rtol=0, atol=0.01
        )
        torch.testing.assert_close(
            read.scales, written.splats[i].gaussians.scales, rtol=0.02, atol=0
        )


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("fourdgs")
    run = write_moving_run(tmp_path / "run")
    assert main(["export", str(run), "--times", "0:1:3", "--out", str(tmp_path / "a.4dgs")]) == 0
    said = capsys.readouterr().out
    assert "3 times, each shown for 1/30 s" in said
    assert "drawn again from 4 cameras" in said
    assert main(["export", str(run), "--format", "4dgs", "--out", str(tmp_path / "b")]) == 2
    assert main(["export", str(run), "--sh-degree", "3", "--out", str(tmp_path / "a.4dgs")]) == 2


def test_without_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    run = open_run(write_moving_run(tmp_path / "run"))
    monkeypatch.setattr(splat_files, "import_module", missing)
    with pytest.raises(DyngsError, match=r"pip install 'dyngs\[4dgs\]'"):
        write_moving(run, tmp_path / "a.4dgs", [0.0])


@pytest.mark.parametrize("kind", KINDS)
def test_edits_of_every_kind_of_scene_are_exact(kind: str) -> None:
    """What moves, is posed or has a 3D filter: seen by cameras moved with it, at a time in
    between."""
    scene = replace(scene_of_kind(kind), colour=None)
    edit = Similarity((0.6, 0.0, 0.8, 0.0), 2.5, (3.0, -1.0, 0.5))
    splat = splats_at(opened_scene(scene), scene, 0.3, Writing(edit=edit, up="y"))
    seen = onlooker()
    before = scene.render(seen, 0.3, background=torch.zeros(3)).rgb
    options = replace(scene.options, near=scene.options.near * edit.scale)
    after = render(splat.gaussians, edit.cameras(seen), options).rgb
    assert float(before.max()) > 0.05
    torch.testing.assert_close(after, before, rtol=0, atol=2e-4)
    assert (splat.edited, splat.up) == (edit, "y")
