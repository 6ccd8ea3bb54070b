"""Linking of blobs into tracks: straight, curved, interrupted, crossing, and noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from dyngs.deform.fixed_cameras.hulls import MAX_GAP, Blob, link_tracks

TIMES = tuple(i / 19 for i in range(20))
RED = (0.9, 0.1, 0.1)
BLUE = (0.1, 0.1, 0.9)
Path = Callable[[float], tuple[float, float, float]]


def blob(
    center: Sequence[float] | np.ndarray, radius: float = 0.2, color: Sequence[float] = RED
) -> Blob:
    place = np.array(center)
    return Blob(place, radius, place[None], 0.1, np.array(color))


def along(path: Path, times: Sequence[float] = TIMES) -> list[list[Blob]]:
    """One blob at each of ``times``, no blob at other times of ``TIMES``."""
    return [[blob(path(t))] if t in times else [] for t in TIMES]


@pytest.mark.parametrize(
    "path",
    [
        lambda t: (4 * t, 0.0, 0.0),
        lambda t: (np.cos(6 * t), np.sin(6 * t), 0.0),
        lambda t: (2 * t, 0.0, abs(np.sin(9 * t))),  # hops
    ],
)
def test_one_object_gives_one_track(path: Path) -> None:
    """The object moves by about its diameter per time step."""
    (track,) = link_tracks(TIMES, along(path))
    assert track.times == TIMES
    assert track.is_travelling
    np.testing.assert_allclose(track.centers, [path(t) for t in TIMES])


def test_track_survives_short_gaps() -> None:
    gone = TIMES[8 : 8 + MAX_GAP]
    (track,) = link_tracks(
        TIMES, along(lambda t: (4 * t, 0.0, 0.0), [t for t in TIMES if t not in gone])
    )
    assert len(track.times) == len(TIMES) - MAX_GAP
    gone = TIMES[8 : 9 + MAX_GAP]
    assert (
        len(
            link_tracks(
                TIMES, along(lambda t: (4 * t, 0.0, 0.0), [t for t in TIMES if t not in gone])
            )
        )
        == 2
    )


def test_crossing_objects_keep_separate_tracks() -> None:
    """Equal colours are separated by velocity, equal positions by colour."""
    for color in (RED, BLUE):
        found = [[blob((3 * t, 0.1, 0)), blob((3 - 3 * t, -0.1, 0), color=color)] for t in TIMES]
        tracks = link_tracks(TIMES, found)
        assert [len(track.times) for track in tracks] == [20, 20]
        for track in tracks:
            assert np.abs(np.diff(track.centers[:, 1])).max() == 0
            assert abs(track.centers[-1, 0] - track.centers[0, 0]) == pytest.approx(3)


def test_oscillating_object_does_not_travel() -> None:
    """Parts of an object that rotates in place seem to oscillate."""
    found = [
        [blob((0.9 * (i % 3 == 0), 0.0, 0.0), 0.1 + 0.1 * (i == 5))] for i in range(len(TIMES))
    ]
    assert not any(track.is_travelling for track in link_tracks(TIMES, found))
    once = [[blob((0.9 * (i > 9), 0.0, 0.0))] for i in range(len(TIMES))]
    assert not any(track.is_travelling for track in link_tracks(TIMES, once))
