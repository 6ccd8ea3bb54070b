"""Tracks: positions that are known, both precisions, and files that hold nothing but arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scene import MOVING_ROWS, TRAIN_TIMES, Sliding, moving_scene, row_of_balls, still_scene

from dyngs.errors import DyngsError
from dyngs.export import tracks as export_tracks
from dyngs.export.tracks import Tracks, tracks_of, write_tracks
from dyngs.static.scene import StaticScene


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
    np.testing.assert_allclose(tracks.positions, expected(TRAIN_TIMES)[list(MOVING_ROWS)], atol=1e-6)
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
    tracks = tracks_of(moving_scene(Sliding()), TRAIN_TIMES, offset)
    assert tracks.positions.dtype == np.float64
    np.testing.assert_allclose(tracks.positions - np.array(offset), expected(TRAIN_TIMES), atol=1e-6)


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


def test_sizes_beyond_the_limit_are_refused_before_memory_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export_tracks, "MAX_BYTES", 5 * 4 * 3 * 4)
    assert tracks_of(moving_scene(Sliding()), (0.0,) * 4).positions.nbytes == 5 * 4 * 3 * 4
    with pytest.raises(DyngsError, match=r"tracks of 5 Gaussians at 5 times .* fewer --times, or --dynamic"):
        tracks_of(moving_scene(Sliding()), (0.0,) * 5)
    monkeypatch.undo()
    with pytest.raises(DyngsError, match=r"6\.0 GB"):
        tracks_of(StaticScene(gaussians=row_of_balls(5)), range(100_000_000))


def test_fields_are_the_arrays_of_the_file() -> None:
    assert set(Tracks.__dataclass_fields__) == {"positions", "times", "moving", "ids"}
